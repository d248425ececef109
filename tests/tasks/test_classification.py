from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional

from tests.tasks.shapes import Shapes, gradients_of, quiet_trainer, shape_task


@pytest.mark.parametrize(("size", "chunks"), [(1, [1] * 4), (15, [2, 2]), (1000, [4])])
def test_chunks_of_whole_shapes_give_the_gradient_of_the_batch(
    size: int, chunks: list[int]
) -> None:
    seen: list[int] = []
    task = shape_task(view_batch_size=size, label_smoothing=0.1)
    task.network.register_forward_pre_hook(lambda _, images: seen.append(len(images[0])))
    found = gradients_of(task, Shapes(4, 4)).found
    assert seen == chunks
    expected = gradients_of(shape_task(label_smoothing=0.1), Shapes(4, 4)).found
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-6)


class Oracle(nn.Module):
    """Takes class 0 and 1 for themselves and class 2 for 0; counts the classes by their channel."""

    def forward(self, images: Tensor) -> Tensor:
        brightest = images.mean(dim=(1, 3, 4)).argmax(dim=1)
        return functional.one_hot(brightest % 2, 3).float()


def test_every_shape_is_counted_once_in_integers() -> None:
    task = shape_task(Oracle())
    data = Shapes(10)  # 4 of class 0, 3 of 1, 3 of 2
    (figures,) = quiet_trainer().test(task, datamodule=data, verbose=False)
    np.testing.assert_array_equal(task.result, [[4, 0, 0], [0, 3, 0], [3, 0, 0]])
    assert task.result.dtype == np.int64
    assert figures["test/accuracy"] == pytest.approx(0.7)
    assert figures["test/class_accuracy"] == pytest.approx(2 / 3)
    (figures,) = quiet_trainer().validate(task, datamodule=data, verbose=False)
    scores = {"val/accuracy", "val/class_accuracy", "val/loss"}
    assert {name for name in figures if name.startswith("val/")} == scores
    assert task.result.sum() == 10, "counted anew"
