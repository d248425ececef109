"""Pictures of the test, and what they keep for the viewer of the report."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from torch import nn

from tangent_train.callbacks.pictures import Pictures
from tests.decoded import decoded
from tests.tasks.builders import segmentation_task

NAMES = ("unknown", "wall", "floor")
SHAPE = (8, 16)


class _Source:
    """Ten panoramas."""

    def __len__(self) -> int:
        return 10

    def name(self, index: int) -> str:
        return f"area/room {index}"

    def read(self, index: int) -> Any:
        return SimpleNamespace(rgb=np.full((*SHAPE, 3), 20 * index, np.uint8), valid=None)


def test_the_panoramas_of_the_panels_are_kept_for_the_report(tmp_path: Path) -> None:
    """After all ten, two a batch; the first labeled pixel is wrong."""
    panels = Pictures(tmp_path, 4)
    trainer: Any = SimpleNamespace(
        datamodule=SimpleNamespace(dataset=lambda split: _Source()), world_size=1
    )
    representation: Any = None
    task = segmentation_task(nn.Identity(), representation, NAMES, partial(torch.optim.SGD, lr=1))
    for first in range(0, 10, 2):
        labels = torch.ones((2, *SHAPE), dtype=torch.uint8)
        prediction = labels.clone().long()
        prediction.flatten(1)[:, 0] = 2
        if first == 8:
            prediction[1, 1, :2] = 2  # room 9 is the worst
        batch = SimpleNamespace(index=torch.tensor([first, first + 1]), labels=labels)
        panels.on_test_batch_end(trainer, task, prediction, batch, first // 2)
    panels.on_test_end(trainer, task)
    chosen = (9, 0, 3, 6)
    assert [image.name for image in panels.images] == [f"area/room {k}" for k in chosen]
    assert {path.stem for path in tmp_path.iterdir()} == {f"{k}_area_room {k}" for k in chosen}
    for image, k in zip(panels.images, chosen, strict=True):
        assert image.sphere
        assert np.abs(decoded(image.input).astype(int) - 20 * k).max() <= 1
        assert np.all(decoded(image.truth) == 1)
        shown = decoded(image.prediction)
        assert shown[0, 0] == 2
        correct = 125 if k == 9 else 127
        assert np.count_nonzero(shown == 1) == correct
        assert image.note == f"mIoU {100 * correct / 128:.1f}\u00a0%", "there is no floor"
