"""Training samples from a prepared store, beside decoding PNGs.

RGB-D and labels of 4 of the 80 images of panoramas of 2048×4096 (level 10, b = 1), one panorama per
batch, one worker process, all files in the page cache.
"""

from __future__ import annotations

import multiprocessing
from typing import TYPE_CHECKING, Any

import cv2

from benchmarks.measuring import Options, Row, Table, Way, at_least, measure, memory_kib
from benchmarks.rooms import AREAS, made_rooms
from datamodules.core.samples import TrainingImages
from datamodules.stanford2d3ds.panoramas import Stanford2D3DS
from tangent_train.rendering.representations.pinhole import TangentRepresentation

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

__all__ = ["tables"]

FACES = 4
PNG = "PNG files"
STORE = "prepared store"

_COPIES = 3
_WARM_UP = 150
"""Samples until the tables of all 80 images are made."""


def tables(options: Options) -> Iterator[Table]:
    """Time, the worker's memory, and the share of all images that a few cost."""
    level = 6 if options.quick else 10
    representation = TangentRepresentation(1, level, faces_per_panorama=FACES)
    root = made_rooms(representation.erp_height, _COPIES)
    png, store = (_data(root, representation, place) for place in (None, root / "store"))
    store.prepare_data()
    yield from _loaders(level, png, store, options)
    yield _few_of_all(store, options)


def _data(root: Path, representation: TangentRepresentation, store: Path | None) -> Stanford2D3DS:
    return Stanford2D3DS(
        root,
        representation,
        areas=AREAS,
        validation_fraction=0,
        panoramas_per_step=1,
        num_workers=1,
        store=store,
    )


class RunningLoader:
    """A training loader whose one worker stays alive.

    Args:
        data: Where it comes from.
        epochs: That are loaded at once.

    Attributes:
        samples: That are loaded at once.
    """

    def __init__(self, data: Stanford2D3DS, epochs: int) -> None:
        self._loader = data.train_dataloader()
        self._epochs, self._epoch = epochs, 0
        self.samples = epochs * len(self._loader)
        before = set(multiprocessing.active_children())
        self.load()
        (self._worker,) = set(multiprocessing.active_children()) - before

    def load(self) -> None:
        """Load the epochs."""
        sampler: Any = self._loader.sampler
        for _ in range(self._epochs):
            sampler.set_epoch(self._epoch)
            self._epoch += 1
            for _batch in self._loader:
                pass

    def mebibytes(self) -> tuple[float, float]:
        """Memory of the worker: its own, and with all that it shares, at most so far.

        Shared are the libraries, what it inherited, and the files of the store in the page cache.
        """
        pid = self._worker.pid or 0
        own, peak = memory_kib("Private_Dirty", pid), memory_kib("VmHWM", pid)
        return own / 2**10, peak / 2**10


def _loaders(
    level: int, png: Stanford2D3DS, store: Stanford2D3DS, options: Options
) -> tuple[Table, Table]:
    loaders = {PNG: RunningLoader(png, 1), STORE: RunningLoader(store, 1 if options.quick else 8)}
    for _ in range(0 if options.quick else _WARM_UP // loaders[STORE].samples):
        loaders[STORE].load()
    ways = [
        Way(name, loader.load, name == STORE, 1 / loader.samples)
        for name, loader in loaders.items()
    ]
    what = f"level {level}, RGB-D, {FACES} of 80 images"
    table = Table("loader: time", f"A training sample: {what}", measure(ways, options.times(5)))
    table.goals = [at_least("as fast as from PNG files", 1 / table.ratio(STORE).median, 20)]
    for row in table.rows:
        table.notes.append(f"{row.name}: {1 / row.median:.1f} samples/s")
    memory = {name: loader.mebibytes() for name, loader in loaders.items()}
    rows = [Row(name, [own], name == STORE) for name, (own, _) in memory.items()]
    of_worker = Table("loader: memory", f"Memory of the worker, its own: {what}", rows, "MiB")
    of_worker.notes = [
        f"{name}: at most {peak:.0f} MiB with what it shares with others"
        for name, (_, peak) in memory.items()
    ]
    return table, of_worker


def _few_of_all(store: Stanford2D3DS, options: Options) -> Table:
    """A sample of a few images beside one of all, in this process."""
    whole = TangentRepresentation(1, store.representation.grid.level)
    source = store.source("train")

    def sampler(representation: TangentRepresentation) -> Callable[[], object]:
        panoramas = TrainingImages(source, representation, 0, ("rgb", "depth"))
        epochs = iter(range(10**9))

        def run() -> object:
            epoch = next(epochs)
            return panoramas[epoch, epoch % len(panoramas)]

        return run

    some = f"{FACES} of 80 images"
    ways = [
        Way("all 80 images", sampler(whole)),
        Way(some, sampler(store.representation), ours=True),
    ]
    threads = cv2.getNumThreads()
    cv2.setNumThreads(0)  # as in a worker
    rows = measure(ways, options.times(9))
    cv2.setNumThreads(threads)
    table = Table("loader: few of all", "A sample from the store, one thread", rows)
    table.notes = [f"{some}: 1/{1 / table.ratio(some).median:.1f} of the time of all"]
    return table
