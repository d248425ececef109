"""Sweeps: every job a run in its own process and folder, whoever launches it."""

from __future__ import annotations

import json
import os
import re
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from submitit.core.utils import JobPaths

from tests.cli.tiny_runs import SETTINGS, Run, results

# Optuna 2.10, all that hydra-optuna-sweeper works with, is written for an old one.
OLD_SQLALCHEMY = pytest.mark.filterwarnings("ignore:Deprecated API features detected")


@pytest.fixture(autouse=True)
def _no_debugger(monkeypatch: pytest.MonkeyPatch) -> None:
    """Hydra takes the tracer of a coverage run for a debugger, and lets exceptions through."""
    monkeypatch.setattr("hydra._internal.utils.is_under_debugger", lambda: False)


@pytest.fixture
def settings(rooms: str) -> tuple[str, ...]:
    """Settings of a run of one epoch."""
    return (*SETTINGS, "data.val_fraction=0.4", "trainer.max_epochs=1", "panels=0", rooms)


def _writers(run: Path) -> set[int]:
    """Processes that logged in a run's folder; TensorBoard puts them into the files' names."""
    names = [path.name for path in (run / "tensorboard").glob("events.*")]
    return {int(name.split(".")[-2]) for name in names}


def _runs(folder: Path) -> list[str]:
    return sorted(path.parent.name for path in folder.glob("*/results.json"))


def test_jobs_of_a_grid_are_runs_of_their_own_on_any_number_of_devices(
    settings: tuple[str, ...], tmp_path: Path, run: Run
) -> None:
    grid = ("-m", "trainer=ddp", "trainer.devices=1,2", "hydra.sweep.dir=a sweep")
    run("train", *grid, *settings)
    runs = [tmp_path / "a sweep" / number for number in "01"]
    assert _runs(tmp_path / "a sweep") == ["0", "1"]
    assert {path.name for path in tmp_path.iterdir()} == {"a sweep"}, "run folders"
    (first,), (second,) = map(_writers, runs)
    assert len({os.getpid(), first, second}) == 3
    for folder, devices in zip(runs, (1, 2), strict=True):
        assert f"\n  devices: {devices}\n" in (folder / "config.yaml").read_text()
        assert results(folder)["images"] == 2
    checkpoint = f"checkpoint={runs[0] / 'checkpoints' / 'last.ckpt'}"
    rotated = ("data.test_rotation=null,so3", "hydra.sweep.dir=rotated")
    data = [text for text in settings if text.startswith("data.")]
    run("evaluate", "-m", checkpoint, "data=synthrooms", *data, *rotated)
    figures = [results(tmp_path / "rotated" / n)["confusion"] for n in "01"]
    assert figures[0] == results(runs[0])["confusion"] != figures[1]


@OLD_SQLALCHEMY
def test_optuna_compares_runs_of_submitit_by_their_validation(
    settings: tuple[str, ...],
    tmp_path: Path,
    run: Run,
    capfd: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def late(*arguments: Any, move: Callable[..., None] = JobPaths.move_temporary_file) -> None:
        time.sleep(2)  # longer than a job needs to open its log
        move(*arguments)

    monkeypatch.setattr(JobPaths, "move_temporary_file", late)
    study = ("hydra.sweeper.n_trials=2", "hydra.sweeper.n_jobs=2", "hydra.sweep.dir=study")
    run("train", "-m", "sweep=optuna", "launcher=local", *study, *settings)
    runs = [tmp_path / "study" / number for number in "01"]
    assert _runs(tmp_path / "study") == ["0", "1"]
    (first,), (second,) = map(_writers, runs)
    assert len({os.getpid(), first, second}) == 3
    found = [json.loads((run / "validation.json").read_text()) for run in runs]
    score = results(runs[1])["scores"]["miou"]
    assert f"study/1: miou {score:.4g}, val/miou {found[1]['best']:.4g}\n" in capfd.readouterr().out
    assert [figure["figure"] for figure in found] == ["val/miou", "val/miou"]
    best = (tmp_path / "study" / "optimization_results.yaml").read_text()
    (value,) = re.findall(r"best_value: (\S+)", best)
    assert float(value) == max(figure["best"] for figure in found)
    (rate,) = re.findall(r"optimizer.lr: (\S+)", best)
    rates = [
        re.findall(r"^  lr: (\S+)", (run / "config.yaml").read_text(), re.MULTILINE)[0]
        for run in runs
    ]
    assert len(set(rates)) == 2
    assert rate in rates


@OLD_SQLALCHEMY
def test_a_search_goes_on_after_runs_that_diverge(
    settings: tuple[str, ...], tmp_path: Path, run: Run
) -> None:
    study = ("hydra.sweeper.n_trials=2", "hydra.sweep.dir=study", "optimizer.lr=choice(1e30,1e31)")
    with pytest.raises(SystemExit, match="No trials are completed"):
        run("train", "-m", "sweep=optuna", *study, *settings)
    for number in "01":
        assert "SettingError: loss of" in (tmp_path / "study" / number / "train.log").read_text()


def test_failing_jobs_are_shown_and_do_not_stop_the_others(
    tmp_path: Path, run: Run, capfd: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as stopped:
        run("train", "-m", "data.fold=4,5", "hydra.sweep.dir=sweep", *SETTINGS)
    error = capfd.readouterr().err
    assert error.count("tangent-train: data.fold: found 4") == 1
    assert error.count("tangent-train: data.fold: found 5") == 1
    assert f"{tmp_path / 'sweep' / '0'}: found a run that ended with status 1" in str(stopped.value)
