"""Training samples per second from a prepared store and from PNGs: ``python -m benchmarks.loader``.

Makes panoramas of 2048×4096 in Stanford2D3DS's format and loads RGB-D and labels of 4 of the 80
images of each (level 10, b = 1), one panorama per batch, with one worker process. What is compared
runs in turn, round after round, and medians are compared. All files are in the page cache.
"""

from __future__ import annotations

import argparse
import multiprocessing
import re
import statistics
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2

from datamodules.samples import TrainingImages
from datamodules.stanford2d3ds import FileName, Stanford2D3DS
from datamodules.synthrooms.generate import generate_rooms
from datamodules.synthrooms.settings import RoomSettings
from tangent_train.rendering.representation import TangentRepresentation

if TYPE_CHECKING:
    from collections.abc import Callable

FACES = 4
COPIES = 4
"""Names of every panorama made for training."""
WARM_UP = 150
"""Samples until the tables of all 80 images are made."""


def main(arguments: list[str] | None = None) -> None:
    """Make the panoramas, then print what was measured."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="a low level and few rounds")
    parser.add_argument("--rounds", type=int, default=5, help="measurements per row")
    options = parser.parse_args(arguments)
    level, rounds = (6, 2) if options.quick else (10, options.rounds)
    representation = TangentRepresentation(1, level, faces_per_panorama=FACES)
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        make_panoramas(root, representation.erp_height)
        png, store = (
            Stanford2D3DS(
                root,
                representation,
                areas=("1", "5a"),
                validation_fraction=0,
                panoramas_per_step=1,
                num_workers=1,
                store=place,
            )
            for place in (None, root / "store")
        )
        start = time.perf_counter()
        store.prepare_data()
        count = sum(len(store.source(split)) for split in ("train", "test"))
        took = (time.perf_counter() - start) / count
        print(f"level {level}: {count} panoramas, prepared in {took:.2f} s each")
        compare_loaders(png, store, rounds)
        compare_samples(store, rounds)


def make_panoramas(root: Path, height: int) -> None:
    """Some rooms, and each of their panoramas under several names."""
    generate_rooms(root, RoomSettings(rooms={"1": 3, "5a": 1}, height=height, supersample=1))
    for path in sorted(root.glob("area_1/pano/*/*.png")):
        name = FileName.parse(path.name)
        for copy in range(1, COPIES):
            camera = f"{copy:x}{name.camera[1:]}"
            path.with_name(str(name._replace(camera=camera))).hardlink_to(path)


class RunningLoader:
    """A training loader whose one worker stays alive.

    Args:
        data: Where it comes from.
    """

    def __init__(self, data: Stanford2D3DS) -> None:
        self._loader = data.train_dataloader()
        self._epoch = 0
        before = set(multiprocessing.active_children())
        self.first = self.rate(1)
        (self._worker,) = set(multiprocessing.active_children()) - before

    def rate(self, samples: int) -> float:
        """Samples per second, over whole epochs of at least so many samples."""
        start, count = time.perf_counter(), 0
        while count < samples:
            sampler: Any = self._loader.sampler
            sampler.set_epoch(self._epoch)
            self._epoch += 1
            count += sum(1 for _ in self._loader)
        return count / (time.perf_counter() - start)

    def memory(self) -> str:
        """Memory of the worker: its own, and with all that it shares, at most so far.

        Shared are the libraries, what it inherited, and the files of the store in the page cache.
        """
        process = Path(f"/proc/{self._worker.pid}")
        if not process.exists():
            return "memory unknown on this system"
        text = (process / "smaps_rollup").read_text() + (process / "status").read_text()
        kilobytes = dict(re.findall(r"(\w+):\s+(\d+) kB", text))
        own, peak = (int(kilobytes[name]) / 1e3 for name in ("Private_Dirty", "VmHWM"))
        return f"worker: {own:.0f} MB of its own, {peak:.0f} MB at most with what it shares"


def compare_loaders(png: Stanford2D3DS, store: Stanford2D3DS, rounds: int) -> None:
    """Samples per second of both, and the memory of the workers."""
    loaders = {"PNG files": RunningLoader(png), "prepared store": RunningLoader(store)}
    samples = {"PNG files": 1, "prepared store": 60}
    loaders["prepared store"].rate(WARM_UP)
    rates: dict[str, list[float]] = {name: [] for name in loaders}
    for _ in range(rounds):
        for name, loader in loaders.items():
            rates[name].append(loader.rate(samples[name]))
    print(f"\nloader, {FACES} of 80 images")
    medians = {name: statistics.median(found) for name, found in rates.items()}
    for name, loader in loaders.items():
        ratio = medians[name] / medians["PNG files"]
        print(f"  {name:<32}{medians[name]:>8.2f} samples/s{ratio:>7.1f}×  {loader.memory()}")
    name, first = "prepared store, first epoch", loaders["prepared store"].first
    print(f"  {name:<32}{first:>8.2f} samples/s  (content checked, tables made)")


def compare_samples(store: Stanford2D3DS, rounds: int) -> None:
    """A sample of a few images beside one of all, in this process."""
    whole = TangentRepresentation(1, store.representation.grid.level)
    source = store.source("train")

    def sampler(representation: TangentRepresentation) -> Callable[[int], object]:
        panoramas = TrainingImages(source, representation, 0, ("rgb", "depth"))
        return lambda epoch: panoramas[epoch, epoch % len(panoramas)]

    few, everything = sampler(store.representation), sampler(whole)
    seconds: tuple[list[float], list[float]] = ([], [])
    threads = cv2.getNumThreads()
    cv2.setNumThreads(0)  # as in a worker
    everything(0)
    for round_ in range(rounds):
        for sample, times, repeats in zip((few, everything), seconds, (20, 1), strict=True):
            for k in range(repeats):
                start = time.perf_counter()
                sample(repeats * round_ + k)
                times.append(time.perf_counter() - start)
    cv2.setNumThreads(threads)
    few_s, all_s = map(statistics.median, seconds)
    print(f"\nsample from the store, in one thread\n  {FACES} of 80 images{few_s * 1e3:>10.1f} ms")
    print(f"  80 of 80 images{all_s * 1e3:>9.1f} ms, {all_s / few_s:.1f}× as long")


if __name__ == "__main__":
    main()
