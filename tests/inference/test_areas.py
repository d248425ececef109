"""Partial panoramas in evaluation and prediction, beside the whole panoramas they are cut from."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import nn

from datamodules.core.dataset import valid_mask
from datamodules.folder.labeled import FolderPanoramas
from tangent_train.config.build import build_from_config
from tangent_train.heads import head_of
from tangent_train.inference.engine import Predictor
from tangent_train.inference.images import InputImage
from tangent_train.inference.views import ViewSelector
from tangent_train.io.gpano import PanoramaArea
from tangent_train.tasks import PixelTask
from tests.datamodules.folder.folder_format import save, write_classes
from tests.inference.trained import (
    CUBE,
    ERP,
    ICOSPHERE,
    TANGENT,
    color_network,
    sphere,
    trained_network,
)
from tests.tasks.builders import predict_labels, segmentation_task
from tests.tasks.shapes import quiet_trainer

SGD = functools.partial(torch.optim.SGD, lr=1.0)
ROWS = 64
AREA = (150, 60, -50.625, 61.875)
RING: dict[str, Any] = {
    "_target_": "tangent_train.rendering.HorizontalRepresentation",
    "level": 5,
    "rings": [{"pitch": 0, "views": 6}, {"pitch": 45, "views": 4}, {"pitch": -45, "views": 4}],
    "fov": 100,
}
KINDS = {
    "tangent": TANGENT | {"level": 5},
    "nearest": TANGENT | {"level": 5, "blend": "nearest", "rotations": 2},
    "cube map": CUBE | {"level": 5},
    "horizontal": RING,
    "equirectangular": ERP | {"level": 5, "rotations": 2},
    "icosphere": ICOSPHERE | {"level": 5},
}


def write_both(root: Path, angles: tuple[float, ...] = AREA) -> tuple[Path, Path]:
    """Whole panoramas whose labels are unknown outside an area, and the same cut to it."""
    canvas = PanoramaArea.on_canvas(angles, ROWS)
    for folder in (root / "whole", root / "part"):
        write_classes(folder, [None, "dark", "green", "bright"])
        (folder / "test.txt").write_text("0\n1\n")
    for number in range(4):
        rgb = np.roll(sphere(ROWS), 7 * number, axis=1)
        labels = np.random.default_rng(number).integers(0, 4, (8, 16), np.uint8)
        labels = labels.repeat(8, axis=0).repeat(8, axis=1)
        for part, image in (("images", rgb), ("labels", labels)):
            save(root / "part" / part / f"{number}.png", np.ascontiguousarray(canvas.cut(image)))
            outside = canvas.place(canvas.cut(image)) if part == "labels" else image
            save(root / "whole" / part / f"{number}.png", outside)
    return root / "whole", root / "part"


def _task(kind: str, network: nn.Module | None = None) -> PixelTask:
    made = build_from_config(KINDS[kind], "representation")
    inner = network or color_network(kernel=1)
    return segmentation_task(inner, made, ("unknown", "dark", "green", "bright"), SGD).eval()


def _data(root: Path, task: PixelTask, **settings: Any) -> FolderPanoramas:
    area = AREA if root.name == "part" else None
    chosen: Any = {"area": area, "fill": "edge", "val_fraction": 0, "seed": 3, **settings}
    return FolderPanoramas(root, task.representation, **chosen)


@pytest.mark.parametrize(
    ("kind", "rotation"),
    [*((kind, "so3") for kind in KINDS), ("tangent", None), ("horizontal", None)],
)
def test_labels_are_those_of_the_whole_panorama(tmp_path: Path, kind: str, rotation: Any) -> None:
    """At the edges, the pixels that a pixel network gets are interpolated with the fill."""
    counts, labels, views = [], [], []
    for root in write_both(tmp_path):
        task = _task(kind)
        data = _data(root, task, test_rotation=rotation)
        metric = task.head.build_metric()
        for plain in data.test_dataloader():
            batch: Any = data.on_after_batch_transfer(plain, 0)
            predicted = predict_labels(
                task,
                batch.images[0],
                tuple(batch.labels[0].shape),
                batch.rotation[0].numpy(),
                valid=valid_mask(batch.valid[0]),
            )
            metric.update(predicted, batch.labels[0])
            labels.append(predicted.where(batch.labels[0] > 0, 0))
            views.append(batch.images.numel())
        counts.append(metric.compute())
    for name in ("pixels", "bands"):  # true classes, which the fill does not change
        expected, found = (getattr(count, name).sum(axis=-1) for count in counts)
        np.testing.assert_array_equal(found, expected)
    expected, found = (count.of_images[:, 1, 0] for count in counts)  # by solid angle
    np.testing.assert_allclose(found, expected, rtol=1e-12)
    assert counts[0].pixels.sum() > 0
    before, after = torch.stack(labels[:2]), torch.stack(labels[2:])
    assert (before == after)[before > 0].double().mean() > 0.98
    is_less = rotation is None and kind in ("tangent", "nearest", "horizontal")
    assert sum(views[2:]) <= sum(views[:2]) - is_less


def test_the_validation_loss_is_that_of_the_labels_in_the_area(tmp_path: Path) -> None:
    logged = []
    for root in write_both(tmp_path):
        task = _task("equirectangular")
        data = _data(root, task, val_fraction=0.5)
        logged.append(quiet_trainer().validate(task, data, verbose=False)[0])
    assert logged[0] == pytest.approx(logged[1], rel=1e-6)
    assert {"val/loss", "val/miou"} < logged[0].keys()


@pytest.mark.parametrize("kind", ["tangent", "nearest", "equirectangular", "icosphere"])
def test_prediction_is_evaluation(tmp_path: Path, kind: str) -> None:
    """Tilted, with a network that sees surroundings."""
    torch.manual_seed(0)
    network = color_network()
    task = _task(kind, network)
    data = _data(write_both(tmp_path)[1], task, fill="reflect")
    panorama = data.dataset("test").read(0)
    zenith = np.array([0.3, 0.2, 0.9]) / np.linalg.norm([0.3, 0.2, 0.9])
    data.dataset("test")._kept = [panorama._replace(up=zenith)] * 2
    batch: Any = data.on_after_batch_transfer(next(iter(data.test_dataloader())), 0)
    expected = predict_labels(
        task,
        batch.images[0],
        tuple(batch.labels[0].shape),
        batch.rotation[0].numpy(),
        valid=valid_mask(batch.valid[0]),
    )
    trained = trained_network(KINDS[kind], module=network, fill="reflect")
    same: dict[str, Any] = {n: KINDS[kind][n] for n in ("blend", "rotations") if n in KINDS[kind]}
    views = ViewSelector(trained, **same)
    black = data.canvas.place(data.canvas.cut(panorama.rgb))
    image = InputImage(black, up=zenith, area=data.canvas)
    labels = Predictor(trained, head_of(trained), views).predict(image).labels()
    cut = data.canvas.cut
    assert len(np.unique(cut(labels.numpy()))) > 1
    np.testing.assert_array_equal(cut(labels.numpy()) + 1, cut(expected.numpy()))
