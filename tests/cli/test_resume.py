"""Runs that are killed, terminated and resumed, and runs of several processes."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch

from tangent_train.cli import main
from tests.dropping import TRUST, write_dropout

# No batch statistics.
PLAIN = """
_target_: torch.nn.Conv2d
in_channels: 4
out_channels: 14
kernel_size: 3
padding: 1
"""
SETTINGS = [
    "experiment=rooms/demo",
    "level=4",
    "representation.crop_multiple=null",
    "data.panoramas_per_step=1",
    "data.validation_fraction=0.2",
    "data.rooms.height=32",
    *(f"data.rooms.rooms.area_{area}=1" for area in ("1", "2", "3", "4", "6")),
    "data.rooms.rooms.area_5a=2",
    "data.rooms.rooms.area_5b=1",
    "trainer.accelerator=cpu",
    "trainer.log_every_n_steps=1",
    "panels=1",
]
COMMAND = Path(sys.executable).parent / "tangent-train"

CUT_SHORT = """
import os, signal, sys
from tangent_train.cli.main import train
from tangent_train.callbacks.checkpoints import LastCheckpoint

original = LastCheckpoint.on_train_batch_end

def cut_short(self, trainer, *rest):
    how = int(os.environ["SIGNAL"])
    now = trainer.global_step == int(os.environ["STEP"]) and trainer.is_global_zero
    if now and how == signal.SIGTERM:
        os.kill(os.getpid(), how)
    original(self, trainer, *rest)
    if now and how == signal.SIGKILL:
        os.kill(os.getpid(), how)

LastCheckpoint.on_train_batch_end = cut_short
if __name__ == "__main__":
    train()
"""


def _run(monkeypatch: pytest.MonkeyPatch, command: str, *arguments: str) -> None:
    monkeypatch.setattr(sys, "argv", [f"tangent-{command}", *arguments])
    getattr(main, command)()


def _last(folder: Path) -> dict[str, Any]:
    content: dict[str, Any] = torch.load(folder / "checkpoints" / "last.ckpt", weights_only=True)
    return content


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """With two networks as options: the one above, and one that has to be trusted."""
    folder = tmp_path_factory.mktemp("settings")
    write_dropout(folder)
    (folder / "network" / "plain.yaml").write_text(PLAIN)
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(folder)
        patch.setenv("PYTHONPATH", str(folder), prepend=os.pathsep)
        yield folder


@pytest.fixture(scope="module")
def settings(folder: Path) -> list[str]:
    """Of the networks and the rooms, which are made."""
    settings = ["--config-dir", str(folder), *SETTINGS, _root(folder)]
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        _run(patch, "prepare", *settings, "network=plain")
    return settings


def _root(folder: Path) -> str:
    """What no file says."""
    return f"data.root={folder / 'rooms'}"


@pytest.fixture(scope="module")
def again(folder: Path) -> list[str]:
    """What has to be said again of a run with dropout."""
    return [_root(folder), TRUST]


@pytest.fixture(scope="module")
def arguments(settings: list[str]) -> list[str]:
    return [*settings, "network=dropout", "trainer.max_epochs=3", "checkpoint_every_n_steps=2"]


@pytest.fixture(scope="module")
def undisturbed(arguments: list[str], tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("run")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        _run(patch, "train", *arguments, "hydra.run.dir=undisturbed")
    return folder / "undisturbed"


def _cut(
    arguments: list[str], folder: Path, how: signal.Signals, step: int
) -> subprocess.CompletedProcess[str]:
    (folder / "cut_short.py").write_text(CUT_SHORT)
    return subprocess.run(
        [sys.executable, "cut_short.py", *arguments, "hydra.run.dir=cut"],
        check=False,
        cwd=folder,
        env=os.environ | {"STEP": str(step), "SIGNAL": str(int(how))},
        capture_output=True,
        text=True,
    )


def _assert_same_end(run: Path, other: Path) -> None:
    found, expected = _last(run), _last(other)
    assert found["global_step"] == expected["global_step"]
    for part in ("state_dict", "optimizer_states"):
        torch.testing.assert_close(found[part], expected[part], rtol=0, atol=0)
    assert found["lr_schedulers"] == expected["lr_schedulers"]
    assert json.loads((run / "results.json").read_text()) == json.loads(
        (other / "results.json").read_text()
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("how", "step", "workers"),
    [
        (signal.SIGKILL, 3, 0),
        (signal.SIGKILL, 9, 2),
        (signal.SIGTERM, 3, 0),
        (signal.SIGTERM, 5, 2),
    ],
    ids=["killed", "killed in a later epoch", "terminated", "terminated at an epoch's end"],
)
def test_a_run_cut_short_goes_on_as_if_nothing_had_happened(
    how: signal.Signals,
    step: int,
    workers: int,
    undisturbed: Path,
    arguments: list[str],
    again: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    cut = _cut(arguments, tmp_path, how, step)
    assert _last(undisturbed)["global_step"] == 15, "three epochs of five steps"
    if how == signal.SIGTERM:
        assert cut.returncode == 128 + signal.SIGTERM, cut.stderr
        assert f"tangent-train resume={tmp_path / 'cut'} " in cut.stderr
        assert again[0] in cut.stderr
        assert "Traceback" not in cut.stderr
        assert _last(tmp_path / "cut")["global_step"] == step, "saved when it was told to end"
    else:
        assert cut.returncode == -signal.SIGKILL, cut.stderr
        assert _last(tmp_path / "cut")["global_step"] == step - 1
    resumed = [f"resume={tmp_path / 'cut'}", *again]
    _run(monkeypatch, "train", *resumed, f"data.num_workers={workers}")
    _assert_same_end(tmp_path / "cut", undisturbed)


def test_checkpoints_say_all_that_later_commands_need(undisturbed: Path) -> None:
    content = _last(undisturbed)
    assert content["config"]["representation"]["level"] == 4
    assert content["kind"] == "segmentation"
    assert content["inputs"] == ["rgb", "depth"]
    assert content["class_names"][:2] == ["unknown", "beam"]
    assert len(content["normalization"]["mean"]) == 4
    assert content["tangent_train_version"]
    assert not list(undisturbed.glob("checkpoints/.partial*"))


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("optimizer.lr=1", r"optimizer\.lr: found 1 for a run that began with"),
        ("data.fold=2", r"data\.fold: found 2 for a run that began with 1"),
        ("seed=3", r"seed: found 3 for a run that began with 0"),
        ("trainer.accumulate_grad_batches=2", r"accumulate_grad_batches: found 2 for a run"),
        ("hydra.run.dir=elsewhere", r"found hydra\.run\.dir=elsewhere beside it"),
    ],
)
def test_a_run_is_not_resumed_as_another(
    undisturbed: Path,
    again: list[str],
    override: str,
    message: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with pytest.raises(SystemExit, match=message):
        _run(monkeypatch, "train", f"resume={undisturbed}", *again, override)


def test_a_run_is_not_resumed_without_its_root_and_what_is_to_be_trusted(
    undisturbed: Path, again: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    root, trust = again
    with pytest.raises(
        SystemExit, match=r"_target_=dropping\.Dropping, .*trust=dropping\.Dropping"
    ):
        _run(monkeypatch, "train", f"resume={undisturbed}", root)
    with pytest.raises(
        SystemExit, match=rf"data\.root: found no folder.* had {re.escape(_quoted(root))}"
    ):
        _run(monkeypatch, "train", f"resume={undisturbed}", trust)


def _quoted(root: str) -> str:
    name, _, value = root.partition("=")
    return f"{name}={value!r}"


def _processes(folder: Path, *arguments: str, command: Path = COMMAND) -> None:
    done = subprocess.run(
        [str(command), *arguments],
        check=False,
        cwd=folder,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
def test_two_processes_make_the_steps_and_figures_of_one(
    settings: list[str], folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    common = [*settings, "network=plain", "trainer.max_steps=3", "optimizer=adam"]
    _run(monkeypatch, "train", *common, "data.panoramas_per_step=2", "hydra.run.dir=one")
    two = ["trainer=ddp", "trainer.accelerator=cpu", "trainer.devices=2", "trainer.max_steps=3"]
    _processes(
        tmp_path, *common, *two, "data.panoramas_per_step=1", "task.images_per_chunk=2",
        "hydra.run.dir=two",
    )  # fmt: skip
    assert {path.name for path in tmp_path.iterdir()} == {"one", "two"}, "one folder each"
    assert len(list((tmp_path / "two" / "tensorboard").glob("events*"))) <= 2
    one, other = _last(tmp_path / "one"), _last(tmp_path / "two")
    assert one["global_step"] == other["global_step"] == 3
    torch.testing.assert_close(other["state_dict"], one["state_dict"], rtol=0, atol=1e-6)
    arguments = [*common, *two, "data.panoramas_per_step=1", "task.images_per_chunk=2"]
    cut = _cut(arguments, tmp_path, signal.SIGTERM, 2)
    assert cut.returncode == 128 + signal.SIGTERM, cut.stderr
    assert _last(tmp_path / "cut")["global_step"] == 2, "all ended after the step"
    _processes(
        tmp_path, f"resume={tmp_path / 'cut'}", _root(folder), "trainer.accelerator=cpu",
        "trainer.devices=2",
    )  # fmt: skip
    _assert_same_end(tmp_path / "cut", tmp_path / "two")
    checkpoint = f"checkpoint={tmp_path / 'one' / 'checkpoints' / 'last.ckpt'}"
    _processes(
        tmp_path, checkpoint, _root(folder), "trainer=ddp", "trainer.accelerator=cpu",
        "trainer.devices=2", "hydra.run.dir=evaluated",
        command=COMMAND.with_name("tangent-evaluate"),
    )  # fmt: skip
    _run(monkeypatch, "evaluate", checkpoint, _root(folder), "hydra.run.dir=again")
    figures = [
        json.loads((tmp_path / folder / "results.json").read_text())
        for folder in ("again", "evaluated")
    ]
    assert figures[0]["confusion"] == figures[1]["confusion"]
    assert figures[0]["miou"] == figures[1]["miou"]
    solid_angle = [figure["miou_solid_angle"] for figure in figures]  # added up in another order
    assert solid_angle[0] == pytest.approx(solid_angle[1], rel=1e-12)
    assert figures[0]["images"] % 2 == 1, "not the same number on both processes"
