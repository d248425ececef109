"""Sweeps: every job a run in its own process and folder, whoever launches it."""

from __future__ import annotations

import json
import os
import re
import signal
import sys
from pathlib import Path
from typing import Any, NoReturn

import pytest
from hydra.core.config_store import ConfigStore
from hydra.core.plugins import Plugins
from submitit.core.utils import FailedJobError

from tangent_train.cli import main, processes, sweep

ROOMS = {"area_1": 2, "area_2": 2, "area_3": 1, "area_4": 1, "area_5a": 1, "area_5b": 1}
SETTINGS = (
    "experiment=rooms/demo",
    "level=4",
    "representation.crop_multiple=null",
    "network.widths=[4,8]",
    "data.panoramas_per_step=2",
    "data.validation_fraction=0.4",
    "data.rooms.height=32",
    *(f"data.rooms.rooms.{area}={n}" for area, n in (ROOMS | {"area_6": 1}).items()),
    "trainer.max_epochs=1",
    "trainer.check_val_every_n_epoch=1",
    "trainer.accelerator=cpu",
    "panels=0",
)

# Optuna 2.10, all that hydra-optuna-sweeper works with, is written for an old one.
OLD_SQLALCHEMY = pytest.mark.filterwarnings("ignore:Deprecated API features detected")


def _run(monkeypatch: pytest.MonkeyPatch, command: str, *arguments: str) -> None:
    monkeypatch.setattr(sys, "argv", [f"tangent-{command}", *arguments])
    getattr(main, command)()


@pytest.fixture(autouse=True)
def _no_debugger(monkeypatch: pytest.MonkeyPatch) -> None:
    """Hydra takes the tracer of a coverage run for a debugger, and lets exceptions through."""
    monkeypatch.setattr("hydra._internal.utils.is_under_debugger", lambda: False)


@pytest.fixture(scope="module")
def settings(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, ...]:
    """Of a short run on rooms that are made once."""
    folder = tmp_path_factory.mktemp("rooms") / "made rooms"
    root = f"data.root='{folder}'"
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder.parent)
        _run(patch, "prepare", *SETTINGS, root)
    return (*SETTINGS, root)


def _json(path: Path) -> dict[str, Any]:
    content: dict[str, Any] = json.loads(path.read_text())
    return content


def _writers(run: Path) -> set[int]:
    """Processes that logged in a run's folder; TensorBoard puts them into the files' names."""
    names = [path.name for path in (run / "tensorboard").glob("events.*")]
    return {int(name.split(".")[-2]) for name in names}


def _runs(folder: Path) -> list[str]:
    return sorted(path.parent.name for path in folder.glob("*/results.json"))


@pytest.mark.slow
def test_jobs_of_a_grid_are_runs_of_their_own_on_any_number_of_devices(
    settings: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    # A folder named as one of this project's packages must not be imported in its place.
    (tmp_path / "models").mkdir()
    (tmp_path / "models" / "__init__.py").write_text("raise ImportError('the wrong models')\n")
    grid = ("-m", "trainer=ddp", "trainer.devices=1,2", "hydra.sweep.dir=a sweep")
    _run(monkeypatch, "train", *grid, *settings)
    runs = [tmp_path / "a sweep" / number for number in "01"]
    assert _runs(tmp_path / "a sweep") == ["0", "1"]
    assert {path.name for path in tmp_path.iterdir()} == {"a sweep", "models"}, "run folders"
    (first,), (second,) = map(_writers, runs)
    assert len({os.getpid(), first, second}) == 3
    for run, devices in zip(runs, (1, 2), strict=True):
        assert f"\n  devices: {devices}\n" in (run / "config.yaml").read_text()
        assert _json(run / "results.json")["images"] == 2


@pytest.mark.slow
@OLD_SQLALCHEMY
def test_optuna_compares_runs_of_submitit_by_their_validation(
    settings: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    study = ("hydra.sweeper.n_trials=2", "hydra.sweeper.n_jobs=2", "hydra.sweep.dir=study")
    _run(monkeypatch, "train", "-m", "sweep=optuna", "launcher=local", *study, *settings)
    runs = [tmp_path / "study" / number for number in "01"]
    assert _runs(tmp_path / "study") == ["0", "1"]
    (first,), (second,) = map(_writers, runs)
    assert len({os.getpid(), first, second}) == 3
    found = [_json(run / "validation.json") for run in runs]
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


@pytest.mark.slow
def test_failing_jobs_are_shown_and_do_not_stop_the_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as stopped:
        _run(monkeypatch, "train", "-m", "data.fold=4,5", "hydra.sweep.dir=sweep", *SETTINGS)
    error, last = capfd.readouterr().err, str(stopped.value.code)
    assert error.count("tangent-train: data.fold: found 4") == 1, "when it happens"
    assert error.count("tangent-train: data.fold: found 5") == 1
    assert last.count("tangent-train: data.fold: found 4") == 1, "and at the end"
    assert f"job 0 in {tmp_path / 'sweep' / '0'} ended with status 1" in last


@OLD_SQLALCHEMY
def test_a_search_without_a_validation_split_is_refused(
    settings: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    message = r"^tangent-train: data\.validation_fraction: found no validation split"
    with pytest.raises(SystemExit, match=message):
        _run(monkeypatch, "train", "-m", "sweep=optuna", *settings, "data.validation_fraction=0")
    assert not list(tmp_path.rglob("checkpoints"))


@pytest.mark.parametrize("choice", ["sweep=optuna", "sweep=folds", "launcher=local"])
def test_a_sweep_has_to_be_asked_for(
    choice: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    wanted = "sweep" if choice == "sweep=folds" else choice
    with pytest.raises(SystemExit, match=rf"{wanted}.*found a single run.*Add -m"):
        _run(monkeypatch, "train", choice)


@pytest.mark.parametrize(
    ("choice", "group", "option", "package"),
    [
        ("sweep=optuna", "sweeper", "optuna", "hydra-optuna-sweeper"),
        ("launcher=slurm", "launcher", "submitit_slurm", "hydra-submitit-launcher"),
    ],
)
def test_what_to_install_is_said(
    choice: str,
    group: str,
    option: str,
    package: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    Plugins.instance()  # registers what is installed, once
    monkeypatch.delitem(ConfigStore.instance().repo["hydra"][group], f"{option}.yaml")
    message = rf"found no {package}.*pip install 'tangent-train\[sweep\]'"
    with pytest.raises(SystemExit, match=message):
        _run(monkeypatch, "train", "-m", choice)


def test_slurm_gets_the_resources_of_the_config(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for name, script in {"srun": "exit 0", "sbatch": f'cp "$1" {tmp_path}/job; exit 1'}.items():
        (tmp_path / "bin").mkdir(exist_ok=True)
        (tmp_path / "bin" / name).write_text(f"#!/bin/sh\n{script}\n")
        (tmp_path / "bin" / name).chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path / 'bin'}:{os.environ['PATH']}")
    asked = ("hydra.launcher.partition=gpu", "hydra.launcher.gpus_per_node=4")
    with pytest.raises((SystemExit, FailedJobError)):
        _run(monkeypatch, "train", "-m", "launcher=slurm", "seed=1,2", "name=try", *asked)
    job = (tmp_path / "job").read_text()
    for option in (
        "job-name=try",
        "partition=gpu",
        "gpus-per-node=4",
        "ntasks-per-node=4",
        "cpus-per-task=8",
        "mem=32GB",
        "time=1440",
        "array=0-1%2",
    ):
        assert f"#SBATCH --{option}\n" in job, job


def test_ctrl_c_has_the_status_of_a_shell(monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: object) -> NoReturn:
        raise KeyboardInterrupt

    monkeypatch.setattr(main, "_compose_and_run", interrupted)
    with pytest.raises(SystemExit) as stopped:
        _run(monkeypatch, "train")
    assert stopped.value.code == 130


def _python(code: str) -> list[str]:
    return [sys.executable, "-c", f"import os, signal, sys, time\n{code}"]


def test_output_and_status_of_a_process_are_passed_on(capsys: pytest.CaptureFixture[str]) -> None:
    code = "print('x', file=sys.stderr)\nfor k in range(40): print(k, file=sys.stderr)\nsys.exit(3)"
    status, last = processes.run_process(_python(code), dict(os.environ))
    assert status == 3
    assert last == [str(k) for k in range(28, 40)]
    assert capsys.readouterr().err.splitlines() == ["x", *map(str, range(40))]


def test_sigterm_reaches_the_job_which_may_finish_its_checkpoint(tmp_path: Path) -> None:
    mark = tmp_path / "saved"
    code = (
        f"def save(*_): time.sleep(0.2); open({str(mark)!r}, 'w'); sys.exit(143)\n"
        "signal.signal(signal.SIGTERM, save)\n"
        "os.kill(os.getppid(), signal.SIGTERM)\n"
        "time.sleep(60)"
    )
    before = signal.getsignal(signal.SIGTERM)
    with pytest.raises(SystemExit) as stopped:
        processes.run_process(_python(code), dict(os.environ))
    assert stopped.value.code == 128 + signal.SIGTERM
    assert mark.exists()
    assert signal.getsignal(signal.SIGTERM) == before


def test_a_schedulers_warning_ends_the_job_with_a_checkpoint(tmp_path: Path) -> None:
    """SLURM signals every process of a job; submitit's raises, in the middle of what it does."""
    mark = tmp_path / "saved"
    code = (
        "from tangent_train.cli.sweep import leave_warnings_to_the_sweep\n"
        "leave_warnings_to_the_sweep()\n"
        f"def save(*_): open({str(mark)!r}, 'w'); sys.exit(143)\n"
        "signal.signal(signal.SIGTERM, save)\n"
        "os.kill(os.getpid(), signal.SIGUSR2)\n"
        "os.kill(os.getppid(), signal.SIGUSR2)\n"
        "time.sleep(60)"
    )

    def warned(*_: object) -> NoReturn:
        raise TimeoutError

    before = signal.signal(signal.SIGUSR2, warned)
    try:
        with pytest.raises(TimeoutError):
            processes.run_process(_python(code), sweep._environment(None))
    finally:
        signal.signal(signal.SIGUSR2, before)
    assert mark.exists()


@pytest.mark.parametrize("deaf", [False, True])
def test_ctrl_c_ends_the_job_even_one_that_does_not_listen(
    deaf: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(processes, "_PATIENCE_S", 0.3)
    number = tmp_path / "pid"
    code = (
        f"open({str(number)!r}, 'w').write(str(os.getpid()))\n"
        + ("signal.signal(signal.SIGTERM, signal.SIG_IGN)\n" if deaf else "")
        + "os.kill(os.getppid(), signal.SIGINT)\ntime.sleep(60)"
    )
    # A shell starts what runs in the background deaf to it.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt):
            processes.run_process(_python(code), dict(os.environ))
    finally:
        signal.signal(signal.SIGINT, before)
    with pytest.raises(ProcessLookupError):
        os.kill(int(number.read_text()), 0)


def test_submitits_local_jobs_see_the_gpus_of_the_sweep(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")
    monkeypatch.setenv("SUBMITIT_EXECUTOR", "local")
    assert "CUDA_VISIBLE_DEVICES" not in sweep._environment(None)
    assert sweep._environment("2,3")["CUDA_VISIBLE_DEVICES"] == "2,3"
    monkeypatch.setenv("SUBMITIT_EXECUTOR", "slurm")
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "5")
    assert sweep._environment("2,3")["CUDA_VISIBLE_DEVICES"] == "5"
