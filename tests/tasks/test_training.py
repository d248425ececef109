"""The gradient of a batch of spheres, in chunks of images and over processes."""

from __future__ import annotations

import os
from functools import partial
from typing import Any
from unittest.mock import patch

import lightning
import pytest
import torch
from lightning.pytorch.strategies import DDPStrategy, SingleDeviceStrategy
from torch import Tensor, nn
from torch.distributed.algorithms.ddp_comm_hooks import default_hooks
from torch.nn.functional import cross_entropy

from tangent_train.tasks import PixelTask
from tests.tasks.builders import segmentation_task
from tests.tasks.shapes import gradients_of
from tests.tasks.test_segmentation import NAMES, TANGENT, WEIGHTS, Data

pytestmark = pytest.mark.filterwarnings("ignore:You defined a `validation_step`:UserWarning")


def _network() -> nn.Module:
    torch.manual_seed(0)
    return nn.Sequential(
        nn.Conv2d(2, 8, 3, padding=1), nn.ReLU(), nn.GroupNorm(2, 8), nn.Conv2d(8, 2, 3, padding=1)
    )


def _task(view_batch_size: int | None = None, **settings: Any) -> PixelTask:
    return segmentation_task(
        _network(),
        TANGENT,
        NAMES,
        settings.pop("optimizer", partial(torch.optim.SGD, lr=0.1)),
        class_weights=WEIGHTS.tolist(),
        label_smoothing=0.1,
        view_batch_size=view_batch_size,
        **settings,
    )


def _gradients(
    view_batch_size: int | None, batch_size: int = 3, trainer: Any = None, **settings: Any
) -> tuple[list[Tensor], Tensor]:
    """Return the gradients of the last step of an epoch of three spheres, and its last loss."""
    given = {"accumulate_grad_batches": 3 // batch_size} | (trainer or {})
    kept = gradients_of(_task(view_batch_size, **settings), Data(batch_size=batch_size), **given)
    return kept.found, kept.loss


def _expected(batch_size: int, batches: int | None = None) -> tuple[list[Tensor], Tensor]:
    """Torch's weighted mean over the labeled pixels of the last batches, and of the last one."""
    network, pixels = _network(), []
    for batch in Data(batch_size=batch_size).train_dataloader():
        labels = batch.labels.flatten(0, 1).long()
        known = labels > 0
        scores = network(batch.images.flatten(0, 1)).movedim(1, -1)[known]
        pixels.append((scores, labels[known] - 1))
    scores, labels = map(torch.cat, zip(*pixels[-(batches or len(pixels)) :], strict=True))
    mean = partial(cross_entropy, weight=WEIGHTS, label_smoothing=0.1)
    gradients = torch.autograd.grad(mean(scores, labels), list(network.parameters()))
    return list(gradients), mean(*pixels[-1]).detach()


@pytest.mark.parametrize(
    ("size", "batch_size"), [(None, 3), (None, 1), (1, 3), (7, 1), (59, 3), (1000, 1)]
)
def test_chunks_give_the_gradient_of_the_whole_batch(size: int | None, batch_size: int) -> None:
    """Accumulated batches too, of which one is unknown and the others have other classes."""
    found, loss = _gradients(size, batch_size)
    expected, expected_loss = _expected(batch_size)
    _assert_same(found, expected)
    torch.testing.assert_close(loss, expected_loss, rtol=1e-5, atol=0)


def test_fewer_batches_at_the_end_of_an_epoch_are_a_whole_step() -> None:
    """Three batches of one sphere, two per step, at a learning rate of 0 before the last one."""
    found, _ = _gradients(
        None, 1, {"accumulate_grad_batches": 2}, optimizer=partial(torch.optim.SGD, lr=0)
    )
    _assert_same(found, _expected(1, batches=1)[0])


def _assert_same(found: list[Tensor], expected: list[Tensor]) -> None:
    for one, other in zip(found, expected, strict=True):
        assert float((one - other).norm() / other.norm()) < 1e-5


class TwinStrategy(SingleDeviceStrategy):
    """Another process does the same as this one; the mean of their gradients is that of one."""

    def reduce(self, tensor: Any, group: Any = None, reduce_op: Any = "mean") -> Any:
        assert reduce_op in ("mean", "sum")
        return 2 * tensor if reduce_op == "sum" else tensor


@pytest.mark.parametrize("batch_size", [3, 1], ids=["plain", "accumulated"])
def test_the_norm_of_processes_is_averaged_as_their_gradients_are(batch_size: int) -> None:
    found, loss = _gradients(7, batch_size, {"strategy": TwinStrategy(torch.device("cpu"))})
    expected, expected_loss = _expected(batch_size)
    _assert_same(found, expected)
    torch.testing.assert_close(loss, expected_loss, rtol=1e-5, atol=0)


def test_gradients_are_clipped_once_as_a_whole() -> None:
    found, _ = _gradients(7, trainer={"gradient_clip_val": 0.01})
    expected, _ = _expected(3)
    flat, whole = (torch.cat([part.flatten() for part in parts]) for parts in (found, expected))
    torch.testing.assert_close(flat, 0.01 * whole / whole.norm(), rtol=1e-3, atol=1e-6)


@pytest.mark.filterwarnings("ignore::DeprecationWarning:torch")
def test_faster_arithmetic_works_in_chunks_and_names_stay() -> None:
    fast: dict[str, Any] = {"channels_last": True, "compile": {"backend": "aot_eager"}}
    assert _task(**fast).state_dict().keys() == _task().state_dict().keys()
    exact, _ = _expected(3)
    found, _ = _gradients(8, trainer={"precision": "bf16-mixed"}, **fast)
    for one, other in zip(found, exact, strict=True):
        assert float((one - other).norm() / other.norm()) < 3e-2


class Exchanges(lightning.Callback):
    """Counts the times that gradients are exchanged between processes."""

    count = 0

    def on_train_start(self, trainer: Any, pl_module: Any) -> None:
        def exchange(state: Any, bucket: Any) -> Any:
            self.count += 1
            return default_hooks.allreduce_hook(state, bucket)

        exchange.__annotations__.clear()  # torch reads them, and strings it does not know
        trainer.strategy.model.register_comm_hook(None, exchange)

    def teardown(self, trainer: Any, pl_module: Any, stage: str) -> None:
        torch.distributed.destroy_process_group()


# Lightning leaves variables behind that tell later processes that they are part of a run.
@patch.dict(os.environ)
@pytest.mark.parametrize("batch_size", [3, 1], ids=["plain", "accumulated"])
def test_processes_exchange_gradients_once_after_the_last_chunk(batch_size: int) -> None:
    exchanges = Exchanges()
    strategy = DDPStrategy(process_group_backend="gloo")
    trainer = {"devices": 1, "strategy": strategy, "callbacks": [exchanges]}
    found, _ = _gradients(7, batch_size, trainer)
    assert exchanges.count == 1
    torch.testing.assert_close(found, _expected(batch_size)[0])
