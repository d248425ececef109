from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional

from tests.tasks.shapes import Gradients, Shapes, SmallNetwork, quiet_trainer, shape_task


def _gradients(
    count: int = 4, batch_size: int = 4, trainer: dict[str, Any] | None = None, **settings: Any
) -> tuple[list[Tensor], Tensor]:
    gradients = Gradients()
    used = {"max_steps": 1} | (trainer or {})
    quiet_trainer(limit_val_batches=0, callbacks=[gradients], **used).fit(
        shape_task(label_smoothing=0.1, **settings), datamodule=Shapes(count, batch_size)
    )
    return gradients.found, gradients.loss


def expected_gradients(count: int, smoothing: float = 0.1) -> tuple[list[Tensor], Tensor]:
    """In float64, of the mean cross-entropy written out."""
    network = shape_task().network.double()
    shapes = Shapes(count).shapes
    scores = network(torch.stack([shape.images for shape in shapes]).double())
    logs = scores - scores.exp().sum(dim=1, keepdim=True).log()
    target = torch.full_like(scores, smoothing / 3)
    for row, shape in zip(target, shapes, strict=True):
        row[shape.label] += 1 - smoothing
    loss = -(target * logs).sum() / count
    return list(torch.autograd.grad(loss, list(network.parameters()))), loss.detach()


def assert_close(found: list[Tensor], expected: list[Tensor], tolerance: float = 1e-5) -> None:
    for one, other in zip(found, expected, strict=True):
        assert float((one.double() - other.double()).norm() / other.double().norm()) < tolerance


@pytest.mark.parametrize("images_per_chunk", [None, 1, 12, 1000])
def test_chunks_give_the_gradient_of_the_whole_batch(images_per_chunk: int | None) -> None:
    found, loss = _gradients(images_per_chunk=images_per_chunk)
    expected, expected_loss = expected_gradients(4)
    assert_close(found, expected)
    assert float(loss) == pytest.approx(float(expected_loss), rel=1e-5)


@pytest.mark.parametrize(("images_per_chunk", "shapes"), [(None, [4]), (1, [1] * 4), (15, [3, 1])])
def test_chunks_are_whole_shapes(images_per_chunk: int | None, shapes: list[int]) -> None:
    class Counting(SmallNetwork):
        def forward(self, images: Tensor) -> Tensor:
            seen.append(len(images))
            return super().forward(images)

    seen: list[int] = []
    task = shape_task(Counting(), images_per_chunk=images_per_chunk)
    quiet_trainer(max_steps=1, limit_val_batches=0).fit(task, datamodule=Shapes(4, 4))
    assert seen == shapes


class Oracle(nn.Module):
    """Takes class 0 and 1 for themselves and class 2 for 0; counts the classes by their channel."""

    def forward(self, images: Tensor) -> Tensor:
        brightest = images.mean(dim=(1, 3, 4)).argmax(dim=1)
        return functional.one_hot(brightest % 2, 3).float()


def test_every_shape_is_counted_once_in_integers() -> None:
    task = shape_task(Oracle())
    data = Shapes(10)  # 4 of class 0, 3 of 1, 3 of 2
    (figures,) = quiet_trainer().test(task, datamodule=data, verbose=False)
    np.testing.assert_array_equal(task.matrices, [[4, 0, 0], [0, 3, 0], [3, 0, 0]])
    assert task.matrices.dtype == np.int64
    assert figures["test/accuracy"] == pytest.approx(0.7)
    assert figures["test/class_accuracy"] == pytest.approx(2 / 3)
    (figures,) = quiet_trainer().validate(task, datamodule=data, verbose=False)
    assert set(figures) == {"val/accuracy", "val/class_accuracy"}
    assert task.matrices.sum() == 10, "counted anew"
