"""The commands end to end on a few made shapes: fit, resume, evaluate, report, refuse."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import pytest
import torch

from tangent_train.callbacks.checkpoints import LastCheckpoint
from tangent_train.cli import main

SETTINGS = [
    "experiment=shapes/default",
    "level=4",
    "network.width=2",
    "data.shapes.train=3",
    "data.shapes.test=2",
    "data.validation_fraction=0.34",
    "trainer.max_epochs=2",
    "trainer.check_val_every_n_epoch=1",
    "trainer.accelerator=cpu",
]


def _run(monkeypatch: pytest.MonkeyPatch, command: str, *arguments: str) -> None:
    monkeypatch.setattr(sys, "argv", [f"tangent-{command}", *arguments])
    getattr(main, command)()


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run, in a folder with its data."""
    folder = tmp_path_factory.mktemp("run")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        _run(patch, "train", *SETTINGS, "hydra.run.dir=finished")
    return folder / "finished"


@pytest.fixture
def here(run_folder: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of run and data, as the working folder."""
    monkeypatch.chdir(run_folder.parent)
    return run_folder.parent


def _results(folder: Path) -> dict[str, Any]:
    results: dict[str, Any] = json.loads((folder / "results.json").read_text())
    return results


def test_a_run_leaves_everything_in_its_folder(run_folder: Path) -> None:
    results = _results(run_folder)
    assert (results["kind"], results["images"], results["noun"]) == ("classification", 20, "shapes")
    assert [entry["images"] for entry in results["classes"]] == [2] * 10
    names = {path.name for path in run_folder.iterdir()}
    assert names >= {"config.yaml", "results.csv", "results.md", "confusion.png", "report.html"}
    assert not (run_folder / "panels").exists()
    page = (run_folder / "report.html").read_text()
    assert all(f"<h2>{title}</h2>" in page for title in ("Validation", "Confusion", "Per class"))
    objective = json.loads((run_folder / "validation.json").read_text())
    assert objective["figure"] == "val/accuracy"
    content = torch.load(run_folder / "checkpoints" / "best.ckpt", weights_only=True)
    assert content["kind"] == "classification"
    assert len(content["class_names"]) == 10
    assert len(content["normalization"]["mean"]) == 6


def test_evaluating_repeats_the_numbers_and_turns_the_shapes(
    run_folder: Path, here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    checkpoint = f"checkpoint={run_folder / 'checkpoints' / 'best.ckpt'}"
    _run(monkeypatch, "evaluate", checkpoint, "hydra.run.dir=again")
    assert _results(here / "again") == _results(run_folder)
    _run(monkeypatch, "evaluate", checkpoint, "data.test_rotation=so3", "hydra.run.dir=turned")
    _run(monkeypatch, "report", str(run_folder), str(here / "turned"), "--output", "both")
    groups = json.loads((here / "both" / "report.json").read_text())["groups"]
    assert sorted(group["rotations"] for group in groups) == ["z / SO3", "z / z"]
    figures = {group["rotations"]: group["means"]["accuracy"]["mean"] for group in groups}
    assert figures["z / z"] == _results(run_folder)["accuracy"]
    assert figures["z / SO3"] == _results(here / "turned")["accuracy"]


def test_an_interrupted_run_ends_the_same(
    run_folder: Path, here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    original = LastCheckpoint.on_train_epoch_end

    def interrupt(self: LastCheckpoint, trainer: Any, task: Any) -> None:
        original(self, trainer, task)
        if trainer.current_epoch == 0:
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(LastCheckpoint, "on_train_epoch_end", interrupt)
        with pytest.raises(SystemExit):
            _run(patch, "train", *SETTINGS, "hydra.run.dir=cut")
    _run(monkeypatch, "train", f"resume={here / 'cut'}")
    assert _results(here / "cut") == _results(run_folder)


@pytest.mark.usefixtures("here")
@pytest.mark.parametrize(
    ("command", "arguments", "message"),
    [
        ("evaluate", ["data=synthrooms"], "task: found classification, with the panoramas of"),
        ("predict", ["input=data", "output=labels"], "found a network for classification; .*"),
        ("export", ["output=x.onnx"], "found a network for classification; expected one for seg"),
        (
            "transfer",
            ["experiment=rooms/transfer"],
            "checkpoint=.*: found a network for classification; expected one for segmentation",
        ),
    ],
)
def test_what_a_classifier_cannot_do_is_refused(
    command: str,
    arguments: list[str],
    message: str,
    run_folder: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    checkpoint = f"checkpoint={run_folder / 'checkpoints' / 'best.ckpt'}"
    (Path.cwd() / "data" / "x.png").write_bytes(b"never read")
    with pytest.raises(SystemExit, match=rf"^tangent-{command}: .*{message}"):
        _run(monkeypatch, command, checkpoint, *arguments)


def test_a_transfer_of_shapes_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    chosen = ["experiment=rooms/transfer", "task=classification", "network=shape_classifier"]
    with pytest.raises(
        SystemExit, match=r"^tangent-transfer: stage P, in photos: task: found clas"
    ):
        _run(monkeypatch, "transfer", *chosen, "hydra.run.dir=x", "~task.class_weights")
    assert not (tmp_path / "data").exists()
