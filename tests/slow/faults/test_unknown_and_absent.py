"""Panoramas without a labelled pixel, and classes that none has: what is learned and reported."""

from __future__ import annotations

import json
import shutil
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import lightning
import numpy as np
import pytest
import torch
from lightning.pytorch.plugins import MixedPrecision

from datamodules.stanford2d3ds.panoramas import Stanford2D3DS
from tangent_train.callbacks.checkpoints import BestCheckpoint
from tangent_train.callbacks.panels import PredictionPanels
from tangent_train.callbacks.results import evaluated, write_evaluation
from tangent_train.cli.train import best_on_validation
from tests.slow.faults.small_runs import Faulty, run_trainer, small_data, small_task

if TYPE_CHECKING:
    from numpy.typing import NDArray


WITHOUT_VALIDATION = pytest.mark.filterwarnings(
    "ignore:You defined a `validation_step`:UserWarning"
)
CLASSES = Stanford2D3DS.class_names


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


def _predictions(
    data: Stanford2D3DS, task: Any
) -> list[tuple[NDArray[np.uint8], NDArray[np.int64]]]:
    """Truth and prediction of every panorama, as arrays."""
    task.eval()
    found = []
    for sample in data.test_dataloader():
        (images,) = data.samples.normalized(sample)
        (truth,) = sample.target
        labels = task.predict_labels(images, tuple(truth.shape))
        found.append((truth.numpy(), labels.numpy().astype(np.int64)))
    return found


def _expected(
    pairs: list[tuple[NDArray[np.uint8], NDArray[np.int64]]], absent: str
) -> dict[str, Any]:
    """The figures from their definitions, class by class, over all pixels of all panoramas."""
    truth = np.concatenate([pair[0].ravel() for pair in pairs])
    labels = np.concatenate([pair[1].ravel() for pair in pairs])
    known = truth > 0
    ious: list[float | None] = []
    for label in range(1, len(CLASSES)):
        true, said = known & (truth == label), known & (labels == label)
        if true.any():
            ious.append(float((true & said).sum() / (true | said).sum()))
        else:
            ious.append(None if absent == "skip" else 0.0)
    counted = [iou for iou in ious if iou is not None]
    miou = float(np.mean(counted)) if counted else None
    return {"ious": ious, "miou": miou, "labelled": int(known.sum())}


def _evaluate(root: Path, tmp_path: Path, absent: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """What a test reports and what it should."""
    data = small_data(root)
    task = small_task(Faulty(), absent_class=absent)
    panels = PredictionPanels(tmp_path / "panels", count=2)
    trainer = run_trainer(tmp_path / "run", callbacks=[panels])
    (logged,) = trainer.test(task, datamodule=data, verbose=False)
    results = evaluated(task, data.noun)
    assert logged["test/miou"] == pytest.approx(
        np.nan if results.means["miou"] is None else results.means["miou"], nan_ok=True
    )
    write_evaluation(task, results, tmp_path / "x.ckpt", tmp_path / "results")
    written = json.loads((tmp_path / "results" / "results.json").read_text())
    assert len(list((tmp_path / "panels").iterdir())) == 2
    return written, _expected(_predictions(data, task), absent)


def _assert_reported(found: dict[str, Any], expected: dict[str, Any]) -> None:
    figures = [found["miou"], *(row["iou"] for row in found["classes"])]
    wanted = [expected["miou"], *expected["ious"]]
    # None where there is no figure.
    np.testing.assert_allclose(
        np.array(figures, np.float64), np.array(wanted, np.float64), rtol=1e-12
    )
    assert np.sum(found["confusion"]) == expected["labelled"]
    assert found["images"] == 5


@pytest.mark.parametrize("absent", ["skip", "zero"])
@pytest.mark.parametrize("how_many", [1, 5])
def test_panoramas_without_a_labelled_pixel(
    root: Path, tmp_path: Path, how_many: int, absent: str
) -> None:
    for path in _label_files(root, "5[ab]")[:how_many]:
        _without_labels(path)
    found, expected = _evaluate(root, tmp_path, absent)
    _assert_reported(found, expected)
    if how_many == 5:
        assert found["miou"] == (None if absent == "skip" else 0)
        assert expected["labelled"] == 0
    assert "nan" not in (tmp_path / "results" / "results.csv").read_text().lower()
    assert "nan" not in (tmp_path / "results" / "results.md").read_text().lower()


def test_a_validation_split_without_a_labelled_pixel_has_no_best_figure(
    root: Path, tmp_path: Path
) -> None:
    data = small_data(root, validation_fraction=0.3)
    names = [data.sample_name("val", i) for i in range(len(data.source("val")))]
    for name in names:
        (path,) = root.glob(f"area_*/pano/semantic/camera_{Path(name).name}_*")
        _without_labels(path)
    best = BestCheckpoint(tmp_path / "checkpoints")
    task = small_task(Faulty())
    trainer = run_trainer(tmp_path, max_epochs=2, limit_val_batches=1.0, callbacks=[best])
    trainer.fit(task, datamodule=data)
    assert (tmp_path / "checkpoints" / "best.ckpt").exists()
    figures = evaluated(task, "panoramas")
    assert figures.means["miou"] is None
    assert figures.images == len(names)
    assert best_on_validation(trainer, tmp_path) is None, "a sweep is not told minus infinity"
    assert not list(tmp_path.glob("*.json"))
