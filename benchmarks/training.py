"""Time the training loader, a training step and an evaluation, compared with minimal code.

The data are a few synthetic rooms in the format of Stanford2D3DS.
"""

from __future__ import annotations

import copy
import io
import logging
import tempfile
import time
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, redirect_stdout
from itertools import count
from pathlib import Path
from typing import Any

import lightning
import torch
from hydra import compose, initialize_config_dir
from lightning.pytorch.callbacks import Callback
from torch import nn
from torch.nn import functional

from benchmarks.measuring import Alternative, Goal, Row, Table, expect_agreement, measure
from tangent_train.callbacks.checkpoints import LastCheckpoint
from tangent_train.cli.run import build
from tangent_train.config.settings import config_name, validate
from tangent_train.files import config_folder

OURS = "tangent-train"
_WARM_UP = 3


@contextmanager
def quiet() -> Iterator[None]:
    """Silence Lightning."""
    logging.getLogger("lightning.pytorch").setLevel(logging.ERROR)
    with warnings.catch_warnings(), redirect_stdout(io.StringIO()):
        warnings.simplefilter("ignore")
        yield


def built(overrides: Sequence[str], root: str, rows: int, rooms: int = 3) -> tuple[Any, Any]:
    """Build data module and task of an experiment on a few rooms, and prepare the data."""
    counts = dict.fromkeys(("1", "2", "3", "4", "5a", "5b", "6"), 0) | {"1": rooms, "5a": 1}
    settings = [f"data.rooms.rooms.area_{area}={number}" for area, number in counts.items()]
    settings += [f"data.rooms.height={rows}", "data.rooms.supersample=1", f"data.root={root}"]
    settings += ["data.val_fraction=0", "trainer.accelerator=cpu", "seed=0"]
    name = config_name("train", ())
    with initialize_config_dir(str(config_folder()), version_base="1.3"):
        config = compose(name, ["data=synthrooms", *settings, *overrides])
    lightning.seed_everything(0, verbose=False)
    data, task = build(validate("train", config))
    data.prepare_data()
    data.setup("fit")
    return data, task


def loader(quick: bool) -> Iterator[Table]:
    """Load samples of 4 of 80 RGB-D images from the cache and from PNGs, with 1 worker."""
    level = 6 if quick else 10
    settings = [f"level={level}", "representation=tangent", "representation.base_level=1"]
    settings += ["representation.faces_per_panorama=4", "data.batch_size=1"]
    settings += ["data.num_workers=1", "data.in_memory=false"]
    with tempfile.TemporaryDirectory() as root, quiet():
        alternatives = []
        caches = {"PNG files": "null", "cache": f"{root}/cache"}
        for name, cache in caches.items():
            overrides = ["experiment=rooms/standard", *settings, f"data.cache={cache}"]
            data, _ = built(overrides, f"{root}/rooms", 2 ** (level + 1))
            epochs = 1 if cache == "null" or quick else 20
            alternatives.append(_loading(name, data, epochs, is_ours=cache != "null"))
        table = Table("loader: time", measure(alternatives, 2 if quick else 5))
    faster = 1 / table.ratio("cache")
    table.goals = [Goal("as fast as from PNG files", faster, 20, True)]
    yield table


def _loading(name: str, data: Any, epochs: int, *, is_ours: bool) -> Alternative:
    batches, epoch = data.train_dataloader(), count()

    def load() -> None:
        for _ in range(epochs):
            batches.sampler.set_epoch(next(epoch))
            for _batch in batches:
                pass

    return Alternative(name, load, is_ours, 1 / (epochs * len(batches)))


def step(quick: bool) -> Iterator[Table]:
    """Time training steps of ``rooms/standard`` and of a bare loop, with the same images.

    Both take steps in turn. The bare loop has a copy of the network and its own loader. Afterwards
    both networks must have the same weights.
    """
    small = ["level=5", "network=unet_small"] if quick else []
    overrides = ["experiment=rooms/standard", "data.batch_size=3", "task.head.class_weights=none"]
    overrides += ["optimizer=adam", "scheduler=constant", *small]
    overrides += ["representation.random_rotation=none"]  # else they would share cached tables
    with tempfile.TemporaryDirectory() as root, quiet():
        data, task = built(overrides, f"{root}/rooms", 64 if quick else 256, rooms=24)
        clock = _StepClock(data, task)
        trainer = lightning.Trainer(
            accelerator="cpu",
            max_steps=_WARM_UP + (2 if quick else 81),
            max_epochs=-1,
            callbacks=[clock, LastCheckpoint(Path(root) / "checkpoints", 1000)],
            default_root_dir=root,
            limit_val_batches=0,
        )
        trainer.fit(task, datamodule=data)
    mine, other = (
        torch.cat([weights.detach().double().flatten() for weights in network.parameters()])
        for network in (clock.network, task.network)
    )
    expect_agreement("the bare loop", 1 - float((mine - other).norm() / mine.norm()), 0.999)
    bare, lightning_s = clock.bare_s[_WARM_UP:], clock.lightning_s[_WARM_UP:]
    table = Table("step: time", [Row("bare loop", bare), Row(OURS, lightning_s, is_ours=True)])
    table.goals = [Goal("overhead, percent", 100 * (table.ratio(OURS) - 1), 3)]
    yield table


class _StepClock(Callback):
    """Runs a step of a bare loop after each training step, and times both."""

    def __init__(self, data: Any, task: Any) -> None:
        self._data = data
        self.network = copy.deepcopy(task.network).train()
        self._format = task.memory_format
        self._batches = self._all_batches()
        self._optimizer: Any = None
        self._start = 0.0
        self.bare_s: list[float] = []
        self.lightning_s: list[float] = []

    def _all_batches(self) -> Iterator[Any]:
        batches = self._data.train_dataloader()
        for epoch in count():
            batches.sampler.set_epoch(epoch)
            yield from batches

    def on_train_start(self, trainer: lightning.Trainer, *_: Any) -> None:
        """Copy the learning rate."""
        rate = trainer.optimizers[0].param_groups[0]["lr"]
        self._optimizer = torch.optim.Adam(self.network.parameters(), rate)
        self._start = time.perf_counter()

    def on_train_batch_end(self, *_: Any) -> None:
        """Run a step of the bare loop."""
        now = time.perf_counter()
        self.lightning_s.append(now - self._start)
        batch = next(self._batches)
        images = self._data.normalized(batch).flatten(0, 1)
        labels = batch.labels.flatten(0, 1).long() - 1
        self._optimizer.zero_grad()
        scores = self.network(images.contiguous(memory_format=self._format))
        loss = functional.cross_entropy(scores, labels, ignore_index=-1)
        torch.autograd.backward(loss)
        self._optimizer.step()
        loss.item()  # as for a progress bar
        self._start = time.perf_counter()
        self.bare_s.append(self._start - now)


def evaluation(quick: bool) -> Iterator[Table]:
    """Time an evaluation without its network, compared with FCN-ResNet50 on a CPU.

    The network is timed on 16 of the 80 images. The rest (reading, rendering, labels, confusion
    matrix) is an evaluation with a network that takes almost no time.
    """
    level = 6 if quick else 10
    overrides = ["experiment=paper/semseg_s10_b1_rgb", f"level={level}", "data=synthrooms"]
    overrides += ["network.depth=50", "network.weights=null"]
    with tempfile.TemporaryDirectory() as root, quiet():
        data, task = built(overrides, f"{root}/rooms", 2 ** (level + 1), rooms=1)
        network, grid = task.network.eval(), data.representation.grid
        images = torch.randn(16, 3, grid.dim, grid.dim)
        task.network = nn.ConstantPad3d((0, 0, 0, 0, 0, data.num_classes - 3), 0.0)
        trainer = lightning.Trainer(accelerator="cpu", logger=False, default_root_dir=root)
        data.setup("test")
        panoramas = len(data.test_dataloader())

        def infer() -> None:
            with torch.inference_mode():
                network(images)

        alternatives = [
            Alternative("the network", infer, scale=grid.num_images / 16),
            Alternative(
                "all else", lambda: trainer.test(task, data, verbose=False), True, 1 / panoramas
            ),
        ]
        table = Table("evaluation: time", measure(alternatives, 2 if quick else 3))
    share = table.ratio("all else")
    table.goals = [Goal("outside the network, percent", 100 * share / (1 + share), 10)]
    yield table
