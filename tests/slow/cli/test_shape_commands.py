"""The commands end to end on a few synthetic shapes: train, evaluate, report, refuse."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch

from tests.cli.tiny_runs import results, run_command, run_in

SETTINGS = (
    "experiment=shapes/default",
    "level=4",
    "network.width=2",
    "data.shapes.train=3",
    "data.shapes.test=2",
    "data.validation_fraction=0.34",
    "trainer.max_epochs=2",
    "trainer.check_val_every_n_epoch=1",
    "trainer.accelerator=cpu",
)


@pytest.fixture(scope="module")
def shapes_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run, in a folder with its data."""
    folder = tmp_path_factory.mktemp("run")
    run_in(folder, "train", *SETTINGS, "hydra.run.dir=finished")
    return folder / "finished"


def test_a_run_leaves_everything_in_its_folder(shapes_run: Path) -> None:
    found = results(shapes_run)
    assert (found["kind"], found["images"], found["noun"]) == ("classification", 20, "shapes")
    names = {path.name for path in shapes_run.iterdir()}
    assert names >= {"config.yaml", "results.csv", "results.md", "report.html"}
    assert not (shapes_run / "panels").exists()
    assert json.loads((shapes_run / "validation.json").read_text())["figure"] == "val/accuracy"
    content = torch.load(shapes_run / "checkpoints" / "best.ckpt", weights_only=True)
    assert content["kind"] == "classification"
    assert len(content["normalization"]["mean"]) == 6


def test_evaluating_repeats_the_numbers_and_rotates_the_shapes(
    shapes_run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(shapes_run.parent)
    checkpoint = f"checkpoint={shapes_run / 'checkpoints' / 'best.ckpt'}"
    run_command(monkeypatch, "evaluate", checkpoint, "hydra.run.dir=again")
    assert results(Path("again")) == results(shapes_run)
    rotated = ["data.test_rotation=so3", "hydra.run.dir=rotated"]
    run_command(monkeypatch, "evaluate", checkpoint, *rotated)
    run_command(monkeypatch, "report", str(shapes_run), "rotated", "--output", "both")
    text = (Path("both") / "report.json").read_text()
    assert "z / SO3" in text
    assert "z / z" in text
