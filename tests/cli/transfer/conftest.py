"""What tests of the commands share."""

from __future__ import annotations

from pathlib import Path

import pytest

from tangent_train.cli import compose
from tangent_train.cli.transfer import command, stage_runs
from tangent_train.results import report
from tests.cli.transfer.pretended_runs import PretendedRuns


@pytest.fixture
def runs(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> PretendedRuns:
    """In place of the stages of a transfer, in an empty folder."""
    pretended = PretendedRuns()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(stage_runs, "run_process", pretended)
    # Tested by themselves, and slow.
    monkeypatch.setattr(command, "_try", lambda _: None)
    monkeypatch.setattr(compose, "check_overrides", lambda *_: None)
    monkeypatch.setattr(report, "report_png", lambda *_: b"a picture")
    return pretended
