"""What an evaluation takes beside its network: panoramas of level 10, FCN-ResNet50.

The network takes so long on a CPU that only one image in sixteen goes through it; its time is
multiplied, its scores are repeated. All else is done in full: reading PNGs, rendering, labels of
2048×4096, the confusion matrix, pictures.
"""

from __future__ import annotations

import io
import tempfile
import time
from contextlib import redirect_stdout
from pathlib import Path
from typing import TYPE_CHECKING, Any

import lightning
from lightning.pytorch.callbacks import Callback
from torch import Tensor, nn

from benchmarks.measuring import Options, Row, Table, at_most, composed
from benchmarks.quiet import quiet_lightning
from benchmarks.rooms import AREAS, made_rooms
from tangent_train.cli import run
from tangent_train.cli.build import build

if TYPE_CHECKING:
    from collections.abc import Iterator

__all__ = ["tables"]

NETWORK = "the network"
REST = "all else"

_COPIES = 3
_EVERY = 16


class EveryNth(nn.Module):
    """A network that sees one image in so many, and what time it takes.

    Args:
        network: The network.
        every: One in so many.

    Attributes:
        seconds: So far, as if all had gone through it.
        taken_s: What it really took.
    """

    def __init__(self, network: nn.Module, every: int) -> None:
        super().__init__()
        self.network = network
        self._every = every
        self.seconds = 0.0
        self.taken_s = 0.0

    def forward(self, images: Tensor) -> Tensor:
        """Scores of all images, those of one in so many repeated."""
        chosen = images[:: self._every]
        start = time.perf_counter()
        returned = self.network(chosen)
        taken = time.perf_counter() - start
        self.taken_s += taken
        self.seconds += taken * len(images) / len(chosen)
        scores: Tensor = returned["out"] if isinstance(returned, dict) else returned
        return scores.repeat_interleave(self._every, dim=0)[: len(images)]


class PanoramaClock(Callback):
    """Time of every panorama, from the end of the one before to its own end.

    Args:
        network: What is asked for its share.

    Attributes:
        inside_s: In the network, of every panorama.
        outside_s: Elsewhere.
    """

    def __init__(self, network: EveryNth) -> None:
        self._network = network
        self._start = (0.0, 0.0, 0.0)
        self.inside_s: list[float] = []
        self.outside_s: list[float] = []

    def _now(self) -> tuple[float, float, float]:
        return time.perf_counter(), self._network.seconds, self._network.taken_s

    def on_test_epoch_start(self, *_: Any) -> None:
        """Start the clock."""
        self._start = self._now()

    def on_test_batch_end(self, *_: Any) -> None:
        """Stop and start it."""
        now = self._now()
        wall, inside, taken = (b - a for a, b in zip(self._start, now, strict=True))
        self.inside_s.append(inside)
        self.outside_s.append(wall - taken)
        self._start = now


def tables(options: Options) -> Iterator[Table]:
    """One."""
    level = 6 if options.quick else 10
    settings = (
        "experiment=paper/semseg_s10_b1_rgb",
        f"level={level}",
        f"data.root={made_rooms(2 ** (level + 1), _COPIES)}",
        f"+data.areas={list(AREAS)}",
        "data.validation_fraction=0",
        "network.depth=50",
        "network.weights=null",
        f"task.images_per_forward={_EVERY}",
        "trainer.accelerator=cpu",
        "trainer.devices=1",
    )
    config = composed(settings)
    with (
        tempfile.TemporaryDirectory() as folder,
        quiet_lightning(),
        redirect_stdout(io.StringIO()),
    ):
        lightning.seed_everything(config["seed"], verbose=False)
        data, task = build(config)
        network = task.network = EveryNth(task.network, _EVERY)
        clock = PanoramaClock(network)
        trainer = run._trainer(config, Path(folder), data, task, [])
        trainer.callbacks.append(clock)  # type: ignore[attr-defined]  # behind those with pictures
        trainer.test(task, datamodule=data, verbose=False)
    rows = [Row(NETWORK, clock.inside_s), Row(REST, clock.outside_s, ours=True)]
    grid = data.representation.grid
    images = f"{grid.num_images} images of {grid.dim}²"
    title = f"Evaluation of a panorama of level {level}, {images}, FCN-ResNet50, CPU"
    table = Table("evaluation: time", title, rows)
    share = 100 * sum(clock.outside_s) / (sum(clock.outside_s) + sum(clock.inside_s))
    table.goals = [at_most("outside the network", share, 10, " %")]
    table.notes = [f"one image in {_EVERY} goes through the network, its time is multiplied"]
    yield table
