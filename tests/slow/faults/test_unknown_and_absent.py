"""Panoramas without labels and classes without pixels, in training and in results."""

from __future__ import annotations

import json
import shutil
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from lightning.pytorch.plugins import MixedPrecision

from tangent_train.callbacks.pictures import Pictures
from tangent_train.results.evaluation import write_results
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


@WITHOUT_VALIDATION
@pytest.mark.parametrize("half", [False, True])
def test_a_batch_without_labels_changes_nothing(root: Path, tmp_path: Path, half: bool) -> None:
    _, *unknown = _label_files(root, "[12346]")
    for path in unknown:
        _without_labels(path)
    plugins = [MixedPrecision("16-mixed", "cpu", torch.amp.GradScaler("cpu"))] if half else []
    trainer = run_trainer(tmp_path / "run", max_epochs=1, plugins=plugins)
    network = Faulty()
    trainer.fit(small_task(network), datamodule=small_data(root, val_fraction=0))
    weights = [*network.weights, network.layer.weight.detach()]
    changed = [not torch.equal(before, after) for before, after in pairwise(weights)]
    assert (len(changed), sum(changed)) == (9, 1)


@pytest.mark.parametrize("absent", ["skip", "zero"])
def test_panoramas_without_a_labeled_pixel_do_not_count(
    root: Path, tmp_path: Path, absent: Any
) -> None:
    for path in _label_files(root, "5[ab]"):
        _without_labels(path)
    data = small_data(root)
    task = small_task(Faulty(), absent_class=absent)
    panels = Pictures(tmp_path / "panels", test=2)
    trainer = run_trainer(tmp_path / "run", callbacks=[panels])
    (logged,) = trainer.test(task, datamodule=data, verbose=False)
    record = task.evaluation_result(task.result, data.noun)
    write_results(record, tmp_path / "results")
    written = json.loads((tmp_path / "results" / "results.json").read_text())
    assert written["images"] == 5
    assert len(list((tmp_path / "panels").iterdir())) == 2
    assert np.sum(written["confusion"]) == 0
    unknown = None if absent == "skip" else 0
    assert written["scores"]["miou"] == unknown
    assert {row["iou"] for row in written["classes"]} == {unknown}
    assert np.isnan(logged["test/miou"]) == (absent == "skip")
    for name in ("results.csv", "results.md"):
        assert "nan" not in (tmp_path / "results" / name).read_text().lower()
