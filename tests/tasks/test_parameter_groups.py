"""Frozen parts of a network, and the learning rates of what was loaded and what is new."""

from __future__ import annotations

from functools import partial
from typing import Any

import lightning
import pytest
import torch
from torch import Tensor
from torch.optim import Adam
from torch.optim.lr_scheduler import CyclicLR, OneCycleLR, StepLR

from tangent_train.errors import SettingError
from tangent_train.tasks.optimization import Schedule
from tests.tasks.shapes import Shapes, SmallNetwork, quiet_trainer, shape_task

pytestmark = pytest.mark.filterwarnings("ignore:Found .* in eval mode")
FRESH = frozenset({"head.weight", "head.bias"})


def _tensors(task: Any) -> dict[str, Tensor]:
    return {name: tensor.clone() for name, tensor in task.network.state_dict().items()}


def _changed(task: Any, before: dict[str, Tensor]) -> set[str]:
    now = task.network.state_dict()
    return {name for name, tensor in before.items() if not torch.equal(tensor, now[name])}


def test_frozen_parts_stay_as_they_are() -> None:
    torch.manual_seed(0)
    frozen, optimizer = ["encoder", "neck.0.weight"], partial(Adam, lr=0.1, weight_decay=0.1)
    task = shape_task(SmallNetwork(statistics=True), optimizer=optimizer, frozen=frozen)
    before = _tensors(task)
    quiet_trainer(max_epochs=2).fit(task, datamodule=Shapes())
    still = {name for name in before if name.startswith("encoder")} | {"neck.0.weight"}
    assert _changed(task, before) == before.keys() - still
    task.eval()
    task.train()
    network: Any = task.network
    assert network.neck.training
    assert not any(module.training for module in network.encoder.modules())


def test_unknown_parts_are_refused() -> None:
    with pytest.raises(SettingError, match=r"task\.frozen: found enc; .*encoder, neck"):
        shape_task(frozen=["enc", "neck"])


def test_loaded_tensors_take_smaller_steps() -> None:
    moved = {}
    for factor in (1, 0.25):
        task = shape_task(backbone_lr_factor=factor)
        task.fresh = FRESH
        before = _tensors(task)
        quiet_trainer(max_steps=1, limit_val_batches=0).fit(task, datamodule=Shapes())
        moved[factor] = {n: t - before[n] for n, t in task.network.state_dict().items()}
    for name, full in moved[1].items():
        share = 1 if name in FRESH else 0.25
        torch.testing.assert_close(moved[0.25][name], share * full, rtol=1e-4, atol=1e-7)
        assert full.any()


@pytest.mark.parametrize(
    ("scheduler", "steps", "last"),
    [
        (partial(StepLR, step_size=1, gamma=0.5), 3, 0.025),
        (Schedule(partial(OneCycleLR, max_lr=0.1, total_steps=None), "step"), 1, 4e-7),
        (
            partial(CyclicLR, base_lr=0.01, max_lr=0.1, step_size_up=1, cycle_momentum=False),
            6,
            0.01,
        ),
    ],
)
def test_schedules_move_both_rates_by_epoch_or_over_the_whole_training(
    scheduler: Any, steps: int, last: float
) -> None:
    """For so many steps the last rate holds."""
    seen: dict[float, list[list[float]]] = {1: [], 0.1: []}

    class Watch(lightning.Callback):
        def on_train_batch_start(self, trainer: Any, pl_module: Any, *_: Any) -> None:
            rates = [group["lr"] for group in trainer.optimizers[0].param_groups]
            seen[pl_module.backbone_lr_factor].append(rates)

    for factor in seen:
        task = shape_task(scheduler=scheduler, backbone_lr_factor=factor)
        task.fresh = FRESH
        quiet_trainer(max_epochs=3, limit_val_batches=0, callbacks=[Watch()]).fit(
            task, datamodule=Shapes()
        )
    assert len(seen[1]) == 9
    assert [rates == seen[1][-1] for rates in seen[1]].count(True) == steps
    assert seen[1][-1] == [pytest.approx(last, rel=0.1)]
    for (whole,), rates in zip(seen[1], seen[0.1], strict=True):
        assert rates == pytest.approx([0.1 * whole, whole])
