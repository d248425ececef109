"""A training step through this project, beside a bare loop of PyTorch.

The run is that of ``tangent-train experiment=rooms/standard`` on a few made rooms, with all that
happens around a step: loading, logging, checkpoints, progress. After each of its steps the bare
loop takes one with a copy of the network and the same images, from a loader of its own: the two are
measured in turn, and end with the same weights, or the comparison is void.
"""

from __future__ import annotations

import copy
import io
import tempfile
import time
from contextlib import redirect_stdout
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any

import lightning
import torch
from lightning.pytorch.callbacks import Callback, LearningRateMonitor
from torch.nn import functional

from benchmarks.measuring import Options, Row, Table, at_most, composed
from benchmarks.quiet import quiet_lightning
from benchmarks.rooms import few_rooms
from tangent_train.callbacks.checkpoints import LastCheckpoint
from tangent_train.cli import run
from tangent_train.cli.build import build

if TYPE_CHECKING:
    from collections.abc import Iterator

__all__ = ["tables"]

BARE = "bare loop"
READY = "bare loop, images ready-made"
OURS = "tangent-train"

_WARM_UP = 3
_SAME = 1e-3
"""Relative difference of all weights that rounding may make over the steps."""

_SETTINGS = (
    "experiment=rooms/standard",
    "data.panoramas_per_step=3",
    "data.validation_fraction=0",
    "task.class_weights=none",
    "optimizer=adam",
    "scheduler=constant",
    "trainer.accelerator=cpu",
    "trainer.devices=1",
    "seed=0",
)


def tables(options: Options) -> Iterator[Table]:
    """One."""
    steps = _WARM_UP + options.times(41)
    small = ["level=5", "network=unet_small"] if options.quick else []
    with tempfile.TemporaryDirectory() as folder:
        rooms = few_rooms(Path(folder) / "rooms", 64 if options.quick else 256)
        config = composed((*_SETTINGS, f"trainer.max_steps={steps}", *small, *rooms))
        with quiet_lightning(), redirect_stdout(io.StringIO()):
            lightning.seed_everything(config["seed"], verbose=False)
            data, task = build(config)
            bare = BareLoop(data, task, config["optimizer"]["lr"])
            clock = StepClock(bare)
            last = LastCheckpoint(Path(folder) / "checkpoints", config["checkpoint_every_n_steps"])
            callbacks = [clock, last, LearningRateMonitor()]
            trainer = run._trainer(config, Path(folder), data, task, callbacks)
            trainer.fit(task, datamodule=data)
    bare.check_same(task.network)
    yield _table(clock, bare)


def _table(clock: StepClock, bare: BareLoop) -> Table:
    whole = [load + step for load, step in zip(bare.loading_s, bare.step_s, strict=True)]
    rows = [
        Row(BARE, whole[_WARM_UP:]),
        Row(OURS, clock.seconds[_WARM_UP:], ours=True),
        Row(READY, bare.step_s[_WARM_UP:]),
    ]
    what = f"UNet, {bare.shape[0]} RGB-D images of {bare.shape[-1]}²"
    table = Table("step: time", f"A training step: {what}, float32", rows)
    overhead = 100 * (table.ratio(OURS).median - 1)
    table.goals = [at_most("overhead", overhead, 3, " %")]
    return table


class BareLoop:
    """A training loop as in PyTorch's tutorials, with a copy of a task's network.

    Args:
        data: Loads the images, as they are loaded for the other training.
        task: Whose network, not yet trained.
        learning_rate: Of Adam.

    Attributes:
        loading_s: Of every step.
        step_s: Of every step, without loading.
        shape: Of the images of the last step.
    """

    def __init__(self, data: Any, task: Any, learning_rate: float) -> None:
        self._data = data
        self._network = copy.deepcopy(task.network).train()
        self._optimizer = torch.optim.Adam(self._network.parameters(), learning_rate)
        self._format = task.memory_format
        self._batches = self._all_batches()
        self.loading_s: list[float] = []
        self.step_s: list[float] = []
        self.shape = torch.Size()

    def _all_batches(self) -> Iterator[Any]:
        loader = self._data.train_dataloader()
        for epoch in count():
            loader.sampler.set_epoch(epoch)
            yield from loader

    def step(self) -> None:
        """Load a batch and train on it; label 0 is unknown."""
        start = time.perf_counter()
        batch = next(self._batches)
        images = self._data.normalized(batch)
        loaded = time.perf_counter()
        images = images.flatten(0, 1).contiguous(memory_format=self._format)
        labels = batch.labels.flatten(0, 1).long()
        self._optimizer.zero_grad()
        scores = self._network(images)
        loss = functional.cross_entropy(scores, labels, ignore_index=0)
        loss.backward()  # type: ignore[no-untyped-call]
        self._optimizer.step()
        loss.item()  # as whoever watches a training does
        self.loading_s.append(loaded - start)
        self.step_s.append(time.perf_counter() - loaded)
        self.shape = images.shape

    def check_same(self, network: torch.nn.Module) -> None:
        """Refuse a comparison of two trainings that are not the same.

        Raises:
            RuntimeError: The weights of the network are others.
        """
        own, others = self._network.state_dict(), network.state_dict()
        pairs = [(own[name].double(), others[name].double()) for name in own]
        difference = sum((a - b).square().sum().item() for a, b in pairs)
        size = sum(a.square().sum().item() for a, _ in pairs)
        if not difference <= _SAME**2 * size:
            raise RuntimeError("the two trainings end with other weights; the comparison is void")


class StepClock(Callback):
    """Takes a bare step after each one of a training, and the time of the training's.

    From the end of one bare step to the beginning of the next everything is the training's own:
    what other callbacks do, and loading.

    Args:
        bare: The other loop.

    Attributes:
        seconds: Of every step.
    """

    def __init__(self, bare: BareLoop) -> None:
        self._bare = bare
        self._start = time.perf_counter()
        self.seconds: list[float] = []

    def on_train_batch_end(self, *_: Any) -> None:
        """Take the other step."""
        self.seconds.append(time.perf_counter() - self._start)
        self._bare.step()
        self._start = time.perf_counter()
