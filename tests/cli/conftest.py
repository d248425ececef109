"""Commands, and a run of a second, finished once for all their tests."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from hydra.core.global_hydra import GlobalHydra
from hydra.core.singleton import Singleton

from tangent_train.cli import transfer
from tangent_train.errors import DataError, SettingError
from tangent_train.results import report
from tests.cli.rendering import Refused, render_with
from tests.cli.tiny_runs import SETTINGS, Predict, Run, predicted, run_command, run_in
from tests.inference.trained import write_checkpoint


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Run:
    """Runs a command in this process, in an empty folder."""
    monkeypatch.chdir(tmp_path)
    return partial(run_command, monkeypatch)


@pytest.fixture
def stages(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    """Stages of transfers, which are within Hydra, run in this process; no chart is drawn."""

    def run_process(line: Sequence[str]) -> int:
        state = Singleton.get_state()
        GlobalHydra.instance().clear()
        run(Path(line[0]).name.removeprefix("tangent-"), *line[1:])
        Singleton.set_state(state)
        return 0

    monkeypatch.setattr(transfer, "run_process", run_process)
    monkeypatch.setattr(report, "report_png", lambda *_: b"a picture")


@pytest.fixture
def predict(tmp_path: Path, run: Run) -> Predict:
    """Labels ``in`` with a small network, into ``out``."""
    checkpoint = write_checkpoint(tmp_path / "model.ckpt")

    def typed(**settings: Any) -> dict[str, Any]:
        given = {"checkpoint": checkpoint, "input": "in", "output": "out", **settings}
        run("predict", *(f"{name}={value}" for name, value in given.items()))
        return predicted(Path(given["output"]))

    return typed


@pytest.fixture
def refused(capsys: pytest.CaptureFixture[str]) -> Refused:
    """See `Refused`."""

    def render(**settings: Any) -> str:
        capsys.readouterr()
        with pytest.raises((SystemExit, DataError, SettingError)) as ended:
            render_with(**settings)
        return capsys.readouterr().out + str(ended.value)

    return render


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
