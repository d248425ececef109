"""Commands, and a run of a second, finished once for all their tests."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import pytest

from tests.cli.tiny_runs import SETTINGS, Run, run_command, run_in


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Run:
    """Runs a command in this process, in an empty folder."""
    monkeypatch.chdir(tmp_path)
    return partial(run_command, monkeypatch)


@pytest.fixture(scope="session")
def rooms(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Where its rooms are."""
    folder = tmp_path_factory.mktemp("rooms") / "synthetic rooms"
    run_in(folder.parent, "prepare", *SETTINGS, f"data.root='{folder}'")
    return f"data.root='{folder}'"


@pytest.fixture(scope="session")
def run_folder(rooms: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run."""
    folder = tmp_path_factory.mktemp("run")
    run_in(folder, "train", *SETTINGS, rooms, "hydra.run.dir=finished")
    return folder / "finished"
