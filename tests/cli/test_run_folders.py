"""Folders of runs: one process has each, and a refused run leaves none."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from filelock import FileLock, Timeout
from hydra.core.hydra_config import HydraConfig

from tangent_train.cli import processes
from tangent_train.cli import train as training
from tests.cli.tiny_runs import Run

HOLDS = """
import os, sys, time
from filelock import FileLock
lock = FileLock(sys.argv[1], blocking=False)
lock.acquire()
if os.fork() == 0:  # as a worker of a data loader
    time.sleep(60)
print("held", flush=True)
time.sleep(60)
"""


@pytest.fixture
def begun(monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """Folders of the runs that begin; their trainings write one file."""
    folders: list[Path] = []

    def train(*_: object) -> None:
        folder = Path(HydraConfig.get().runtime.output_dir)
        (folder / "results.json").touch()
        folders.append(folder)

    monkeypatch.setattr(training, "train", train)
    return folders


def test_runs_that_start_at_the_same_time_have_folders_of_their_own(
    tmp_path: Path, run: Run, begun: list[Path]
) -> None:
    for seed in range(3):  # within one second that lasts a year
        run("train", f"seed={seed}", "hydra.run.dir=runs/${now:%Y}")
    first, *others = begun
    assert [folder.name for folder in others] == [f"{first.name}_2", f"{first.name}_3"]
    for seed, folder in enumerate(begun):
        assert f"\nseed: {seed}\n" in (folder / ".hydra" / "config.yaml").read_text()
    run("train", "hydra.run.dir=runs/mine")
    run("train", "hydra.run.dir=runs/mine")  # as typed
    assert begun[-1] == begun[-2] == tmp_path / "runs" / "mine"


def test_a_running_run_is_left_alone_by_all_but_its_own_processes(
    run: Run, begun: list[Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(processes, "end_with_first_process", lambda: None)
    run("train", "seed=1", "hydra.run.dir=mine")
    settings = (begun[0] / ".hydra" / "config.yaml").read_bytes()
    with FileLock(begun[0] / ".run.lock"):
        with pytest.raises(SystemExit, match=r"^tangent-train: mine: found a run that is still"):
            run("train", "seed=2", "hydra.run.dir=mine")
        assert (begun[0] / ".hydra" / "config.yaml").read_bytes() == settings
        monkeypatch.setenv("LOCAL_RANK", "1")
        run("train", "hydra.run.dir=mine", "hydra.output_subdir=null")
    assert begun == begun[:1] * 2
    monkeypatch.delenv("LOCAL_RANK")
    run("train", "seed=3", "hydra.run.dir=mine")


@pytest.mark.skipif(not hasattr(os, "fork"), reason="workers are forked")
def test_a_lock_ends_with_its_process_though_its_workers_live(tmp_path: Path) -> None:
    lock = tmp_path / ".run.lock"
    command = [sys.executable, "-c", HOLDS, str(lock)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, start_new_session=True) as holder:
        assert holder.stdout is not None
        assert holder.stdout.readline() == b"held\n"
        with pytest.raises(Timeout):
            FileLock(lock, blocking=False).acquire()
        holder.kill()
        holder.wait()
        with FileLock(lock, timeout=1):
            pass
        os.killpg(holder.pid, signal.SIGKILL)


@pytest.mark.parametrize(
    ("command", "arguments"),
    [
        ("train", ("level=high",)),
        ("train", ("representation.faces_per_panorama=99",)),
        ("train", ("data=folder", "data.root=nowhere")),
        ("train", ("data=folder", "data.root=.")),
        ("train", ("experiment=rooms/demo", "task.backbone_lr_factor=0.5")),
        ("train", ("init_from=nowhere", "hydra.run.dir=a/b/c")),
        ("evaluate", ("checkpoint=net.onnx", "data=folder", "data.root=nowhere")),
        ("transfer", ("data=folder", "data.root=nowhere")),
    ],
)
def test_a_refused_run_leaves_nothing(
    command: str, arguments: tuple[str, ...], tmp_path: Path, run: Run
) -> None:
    (tmp_path / "net.onnx").touch()
    with pytest.raises(SystemExit, match=f"^tangent-{command}: "):
        run(command, *arguments)
    assert [path.name for path in tmp_path.iterdir()] == ["net.onnx"]


@pytest.mark.parametrize("name", ["${oc.env:HOME}", "${now:%Y}"])
def test_folders_that_hydra_would_rename_are_refused(
    name: str, tmp_path: Path, run: Run, begun: list[Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    refused = pytest.raises(
        SystemExit, match=r"^tangent-train: .*found a name with \$\{, which Hydra"
    )
    (tmp_path / name).mkdir()
    monkeypatch.chdir(tmp_path / name)
    with refused:
        run("train")
    assert not list((tmp_path / name).iterdir())
    assert begun == []


def test_existing_files_stay_when_a_run_is_refused(tmp_path: Path, run: Run) -> None:
    (tmp_path / "mine").mkdir()
    with pytest.raises(SystemExit, match="level: found high"):
        run("train", "level=high", "hydra.run.dir=mine")
    assert (tmp_path / "mine").is_dir()
