"""What several processes make of one batch, and the mode of networks; without starting any."""

from __future__ import annotations

from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import pytest
import torch
from torch import Tensor, nn

from datamodules.core.samples import TrainingSample
from tests.conftest import ROOMS
from tests.slow.faults.small_runs import run_trainer, small_data, small_task

if TYPE_CHECKING:
    from pathlib import Path

    from tangent_train.tasks import SegmentationTask
    from tests.conftest import FabricateStanford


class _Together:
    """The strategy of one of several processes, of which the others' norms are known."""

    def __init__(self, norms: list[Tensor]) -> None:
        self._mean = torch.stack(norms).mean(dim=0)
        self._asked = 0

    def reduce(self, value: Tensor, reduce_op: str) -> Tensor:
        assert reduce_op == "mean"
        self._asked += 1
        return self._mean if self._asked == 1 else value  # then the loss, which is only shown

    def backward(self, loss: Tensor, _: None) -> None:
        loss.backward()  # type: ignore[no-untyped-call]


def _batch(labelled: float, seed: int) -> Any:
    generator = torch.Generator().manual_seed(seed)
    images = torch.randn(1, 20, 3, 16, 16, generator=generator)
    labels = torch.randint(1, 14, (1, 20, 16, 16), generator=generator).to(torch.uint8)
    labels[torch.rand(labels.shape, generator=generator) > labelled] = 0
    return TrainingSample(images, labels, torch.zeros(1, 0), index=torch.zeros(1))  # type: ignore[arg-type]


def _gradient(task: SegmentationTask, batch: Any, norms: list[Tensor]) -> Tensor:
    optimizer = torch.optim.SGD(task.parameters(), lr=1)
    trainer: Any = SimpleNamespace(
        accumulate_grad_batches=1, optimizers=[optimizer], strategy=_Together(norms)
    )
    task._trainer = trainer
    task.log = lambda *_, **__: None  # type: ignore[method-assign]
    task.training_step(batch, 0).backward()  # type: ignore[no-untyped-call]
    return torch.cat([p.grad.flatten() for p in task.network.parameters() if p.grad is not None])


@pytest.mark.parametrize("chunk", [None, 7])
def test_the_mean_of_two_processes_gradients_is_that_of_their_batches_together(
    chunk: int | None,
) -> None:
    """Though one has many more labelled pixels than the other."""
    torch.manual_seed(0)
    task = small_task(nn.Conv2d(3, 14, 3, padding=1), class_weights=list(range(1, 15)))
    task.images_per_chunk = chunk
    task.class_weights.copy_(torch.arange(1.0, 15.0))
    full, sparse = _batch(0.9, 1), _batch(0.1, 2)
    norms = [task.loss_norm(task.training_labels(batch)) for batch in (full, sparse)]
    of_each = [_gradient(task, batch, norms) for batch in (full, sparse)]
    pairs: Any = [torch.cat(pair) for pair in zip(full, sparse, strict=True)]
    both: Any = TrainingSample(*pairs)
    alone = _gradient(task, both, [task.loss_norm(task.training_labels(both))])
    torch.testing.assert_close(sum(of_each) / 2, alone, rtol=1e-4, atol=1e-6)


class _Noting(nn.Conv2d):
    """A network that notes in which mode it runs."""

    def __init__(self) -> None:
        super().__init__(3, 14, 1)
        self.modes: list[bool] = []

    def forward(self, images: Tensor) -> Tensor:
        self.modes.append(self.training)
        return super().forward(images)


@pytest.mark.filterwarnings("ignore:You defined a `validation_step`:UserWarning")
def test_networks_are_evaluated_in_evaluation_mode(
    fabricate_stanford: FabricateStanford, tmp_path: Path
) -> None:
    """Also after they were trained."""
    data = small_data(fabricate_stanford(tmp_path / "data", ROOMS))
    task = small_task(_Noting())
    trainer = run_trainer(tmp_path, max_steps=1)
    trainer.fit(task, datamodule=data)
    network: Any = task.network
    assert all(network.modes)
    network.modes.clear()
    for evaluate in (trainer.test, trainer.validate):
        task.train()
        evaluate(task, datamodule=data, verbose=False)
    assert network.modes
    assert not any(network.modes)
