"""TensorBoard's files of a small training, read with its own reader."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lightning.pytorch.loggers import TensorBoardLogger
from tensorboard.backend.event_processing.event_accumulator import (  # type: ignore[import-untyped]
    EventAccumulator,
)
from torch import nn

from datamodules import Stanford2D3DS
from datamodules.core.inputs import normalize
from datamodules.core.samples import render_inputs
from tangent_train.callbacks.tensorboard import ClassScores, ValidationPictures
from tangent_train.rendering import TangentRepresentation
from tangent_train.results.pictures import prediction_panel
from tangent_train.tasks import SegmentationTask
from tests.decoded import decoded
from tests.tasks.shapes import Shapes, quiet_trainer, shape_task

TANGENT = TangentRepresentation(base_level=0, level=4, faces_per_panorama=5)
STEPS = 3  # of an epoch: 6 panoramas, 2 at a time


def _fit(folder: Path, data: Any, task: Any, count: int = 2) -> None:
    trainer = quiet_trainer(
        max_epochs=2,
        logger=TensorBoardLogger(folder, name="", version="tensorboard"),
        callbacks=[ValidationPictures(count), ClassScores()],
        num_sanity_val_steps=1,
        log_every_n_steps=1,
        default_root_dir=folder,
    )
    trainer.fit(task, datamodule=data)


def _events(folder: Path) -> EventAccumulator:
    events = EventAccumulator(str(folder / "tensorboard"), size_guidance={"images": 0})
    events.Reload()
    return events


def _steps(events: EventAccumulator, tag: str) -> list[int]:
    kind = events.Images if tag in events.Tags()["images"] else events.Scalars
    return [event.step for event in kind(tag)]


def _tags(events: EventAccumulator, kind: str, group: str) -> list[str]:
    return sorted(tag for tag in events.Tags()[kind] if tag.startswith(group))


@pytest.fixture(scope="module")
def trained(
    stanford_root: Path, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, SegmentationTask, Stanford2D3DS]:
    """Two epochs of panoramas."""
    folder = tmp_path_factory.mktemp("trained")
    # Validation: 3 panoramas of 2 rooms.
    split: Any = {"validation_fraction": 0.35, "seed": 3}
    data = Stanford2D3DS(stanford_root, TANGENT, panoramas_per_step=2, **split)
    torch.manual_seed(0)
    sgd = partial(torch.optim.SGD, lr=0.1)
    task = SegmentationTask(nn.Conv2d(4, 13, 1), TANGENT, data.class_names, sgd)
    _fit(folder, data, task)
    return folder, task, data


def test_the_same_images_are_shown_after_every_validation(
    trained: tuple[Path, SegmentationTask, Stanford2D3DS],
) -> None:
    folder, task, data = trained
    events, source = _events(folder), data.source("val")
    assert len(source) == 3
    chosen = {f"val_images/{source.name(k).replace('/', '_')}": k for k in (0, 2)}
    assert _tags(events, "images", "val_images/") == sorted(chosen), "first and last of 3"
    for tag, index in chosen.items():
        assert _steps(events, tag) == _steps(events, "val/miou") == [STEPS - 1, 2 * STEPS - 1]
        panorama = source.read(index)
        normalization: Any = data.normalization
        inputs = render_inputs(panorama, TANGENT.whole(), data.inputs)
        with torch.no_grad():
            scores = task.network(normalize(inputs, normalization, data.inputs))
        labels = TANGENT.to_labels(scores, (32, 64)).numpy() + 1
        expected = prediction_panel(panorama.rgb, panorama.labels, labels, data.class_names)
        shown = decoded(events.Images(tag)[-1].encoded_image_string)
        np.testing.assert_array_equal(shown, expected)


def test_figures_of_every_class_are_those_of_numpy(
    trained: tuple[Path, SegmentationTask, Stanford2D3DS],
) -> None:
    folder, task, data = trained
    events = _events(folder)
    matrix = task.result.pixels
    present = [k for k in range(1, 14) if matrix[k].sum()]
    named = {f"val_iou/{data.class_names[k]}": k for k in present}
    assert _tags(events, "scalars", "val_iou/") == sorted(named)
    assert named, "no class to compare"
    for tag, k in named.items():
        union = matrix[k].sum() + matrix[1:, k].sum() - matrix[k, k]
        assert _steps(events, tag) == [STEPS - 1, 2 * STEPS - 1]
        assert events.Scalars(tag)[-1].value == pytest.approx(matrix[k, k] / union, rel=1e-6)
    mean = np.mean([events.Scalars(tag)[-1].value for tag in named])
    assert mean == pytest.approx(events.Scalars("val/miou")[-1].value, rel=1e-6)


def test_shapes_have_accuracies_and_no_unknown_class(tmp_path: Path) -> None:
    task: Any = shape_task()
    _fit(tmp_path, Shapes(), task, count=0)
    events = _events(tmp_path)
    assert _steps(events, f"val_accuracy/{task.class_names[0]}") == [2, 5]
    mean = np.mean([events.Scalars(f"val_accuracy/{n}")[-1].value for n in task.class_names])
    assert mean == pytest.approx(events.Scalars("val/class_accuracy")[-1].value, rel=1e-6)
