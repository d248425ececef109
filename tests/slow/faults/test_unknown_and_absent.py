"""Panoramas without a labelled pixel and classes that none has, in training and in results."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import lightning
import numpy as np
import pytest
import torch
from lightning.pytorch.plugins import MixedPrecision

from tangent_train.callbacks.panels import PredictionPanels
from tangent_train.callbacks.results import evaluated, write_evaluation
from tests.slow.faults.small_runs import Faulty, run_trainer, small_data, small_task

WITHOUT_VALIDATION = pytest.mark.filterwarnings(
    "ignore:You defined a `validation_step`:UserWarning"
)


@pytest.fixture
def root(stanford_root: Path, tmp_path: Path) -> Path:
    return shutil.copytree(stanford_root, tmp_path / "data")


def _label_files(root: Path, areas: str = "*") -> list[Path]:
    return sorted(root.glob(f"area_{areas}/pano/semantic/*.png"))


def _without_labels(path: Path) -> None:
    """Label 0 everywhere, what Stanford2D3DS calls <UNK>."""
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert image is not None
    assert cv2.imwrite(str(path), np.zeros_like(image))


class Steps(lightning.Callback):
    """Keeps the loss, the labelled pixels and the weights of every step."""

    def __init__(self) -> None:
        self.losses: list[float] = []
        self.labelled: list[int] = []
        self.weights: list[torch.Tensor] = []

    def on_train_batch_end(
        self, trainer: Any, pl_module: Any, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        self.losses.append(float(trainer.callback_metrics["train/loss"]))
        self.labelled.append(int((batch.labels > 0).sum()))
        self.weights.append(pl_module.network.layer.weight.detach().clone())


@WITHOUT_VALIDATION
@pytest.mark.parametrize(("settings", "half"), [({}, False), ({"images_per_chunk": 7}, True)])
def test_a_batch_without_labels_changes_nothing(
    root: Path, tmp_path: Path, settings: dict[str, Any], half: bool
) -> None:
    _, *unknown = _label_files(root, "[12346]")
    for path in unknown:
        _without_labels(path)
    plugins = [MixedPrecision("16-mixed", "cpu", torch.amp.GradScaler("cpu"))] if half else []
    steps = Steps()
    trainer = run_trainer(tmp_path / "run", max_epochs=1, plugins=plugins, callbacks=[steps])
    network = Faulty()
    weights = [network.layer.weight.detach().clone()]
    task = small_task(network, optimizer=partial(torch.optim.SGD, lr=0.01), **settings)
    trainer.fit(task, datamodule=small_data(root, validation_fraction=0))
    weights += steps.weights
    assert len(steps.losses) == 9
    assert sum(count > 0 for count in steps.labelled) == 1
    for step, (loss, labelled) in enumerate(zip(steps.losses, steps.labelled, strict=True)):
        same = torch.equal(weights[step], weights[step + 1])
        if labelled:
            assert loss > 0
            assert not same
        else:
            assert loss == 0
            assert same


@pytest.mark.parametrize("absent", ["skip", "zero"])
@pytest.mark.parametrize("how_many", [1, 5])
def test_panoramas_without_a_labelled_pixel(
    root: Path, tmp_path: Path, how_many: int, absent: str
) -> None:
    for path in _label_files(root, "5[ab]")[:how_many]:
        _without_labels(path)
    data = small_data(root)
    task = small_task(Faulty(), absent_class=absent)
    panels = PredictionPanels(tmp_path / "panels", count=2)
    trainer = run_trainer(tmp_path / "run", callbacks=[panels])
    (logged,) = trainer.test(task, datamodule=data, verbose=False)
    figures = evaluated(task, data.noun)
    write_evaluation(task, replace(figures, checkpoint="x.ckpt"), tmp_path / "results")
    written = json.loads((tmp_path / "results" / "results.json").read_text())
    assert written["images"] == 5
    assert len(list((tmp_path / "panels").iterdir())) == 2
    if how_many == 1:
        assert logged["test/miou"] == pytest.approx(written["miou"])
        assert written["miou"] > 0
    else:
        assert np.sum(written["confusion"]) == 0
        unknown = None if absent == "skip" else 0
        assert written["miou"] == unknown
        assert {row["iou"] for row in written["classes"]} == {unknown}
        assert np.isnan(logged["test/miou"]) == (absent == "skip")
    for name in ("results.csv", "results.md"):
        assert "nan" not in (tmp_path / "results" / name).read_text().lower()
