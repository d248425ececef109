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
from tangent_train.callbacks.tensorboard import ClassScores
from tangent_train.rendering import TangentRepresentation
from tangent_train.tasks import SegmentationTask
from tests.tasks.shapes import Shapes, quiet_trainer, shape_task

TANGENT = TangentRepresentation(base_level=0, level=4, faces_per_panorama=5)
STEPS = 3  # of an epoch: 6 panoramas, 2 at a time


def _fit(folder: Path, data: Any, task: Any) -> None:
    trainer = quiet_trainer(
        max_epochs=2,
        logger=TensorBoardLogger(folder, name="", version="tensorboard"),
        callbacks=[ClassScores()],
        num_sanity_val_steps=1,
        log_every_n_steps=1,
        default_root_dir=folder,
    )
    trainer.fit(task, datamodule=data)


def _events(folder: Path) -> EventAccumulator:
    events = EventAccumulator(str(folder / "tensorboard"))
    events.Reload()
    return events


def _steps(events: EventAccumulator, tag: str) -> list[int]:
    return [event.step for event in events.Scalars(tag)]


def test_figures_of_every_class_are_those_of_numpy(stanford_root: Path, tmp_path: Path) -> None:
    # Validation: 3 panoramas of 2 rooms.
    split: Any = {"validation_fraction": 0.35, "seed": 3}
    data = Stanford2D3DS(stanford_root, TANGENT, panoramas_per_step=2, **split)
    torch.manual_seed(0)
    sgd = partial(torch.optim.SGD, lr=0.1)
    task = SegmentationTask(nn.Conv2d(4, 13, 1), TANGENT, data.class_names, sgd)
    _fit(tmp_path, data, task)
    events = _events(tmp_path)
    matrix = task.matrices.pixels
    present = [k for k in range(1, 14) if matrix[k].sum()]
    named = {f"val_iou/{data.class_names[k]}": k for k in present}
    tags = [tag for tag in events.Tags()["scalars"] if tag.startswith("val_iou/")]
    assert sorted(tags) == sorted(named)
    assert named, "no class to compare"
    for tag, k in named.items():
        union = matrix[k].sum() + matrix[1:, k].sum() - matrix[k, k]
        assert _steps(events, tag) == [STEPS - 1, 2 * STEPS - 1]
        assert events.Scalars(tag)[-1].value == pytest.approx(matrix[k, k] / union, rel=1e-6)
    mean = np.mean([events.Scalars(tag)[-1].value for tag in named])
    assert mean == pytest.approx(events.Scalars("val/miou")[-1].value, rel=1e-6)


def test_shapes_have_accuracies_and_no_unknown_class(tmp_path: Path) -> None:
    task: Any = shape_task()
    _fit(tmp_path, Shapes(), task)
    events = _events(tmp_path)
    assert _steps(events, f"val_accuracy/{task.class_names[0]}") == [2, 5]
    mean = np.mean([events.Scalars(f"val_accuracy/{n}")[-1].value for n in task.class_names])
    assert mean == pytest.approx(events.Scalars("val/class_accuracy")[-1].value, rel=1e-6)
