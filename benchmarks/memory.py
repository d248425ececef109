"""Memory and time of one training step in chunks: ``python -m benchmarks.memory``, on Linux.

Every row is a process of its own that trains the paper's UNet on tangent images of made-up
panoramas, RGB-D, float32. Counted is what the steps add to the process's peak memory.
"""

from __future__ import annotations

import argparse
import logging
import time
import warnings
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any, NamedTuple

import lightning
import torch
from torch import Tensor
from torch.utils.data import DataLoader

from models import UNet
from tangent_train.rendering import TangentRepresentation
from tangent_train.tasks import SegmentationTask

IMAGES = 20
NUM_CLASSES = 14


class Sample(NamedTuple):
    """One panorama's images."""

    images: Tensor
    labels: Tensor


class Step(NamedTuple):
    """What a step took."""

    mebibytes: float
    seconds: float


def main(arguments: list[str] | None = None) -> None:
    """Print one row per number of panoramas and chunk size."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="small images of one panorama")
    quick = parser.parse_args(arguments).quick
    level = 6 if quick else 7
    print(f"\nUNet, images of {2**level}², {IMAGES} per panorama")
    for panoramas in (1,) if quick else (1, 2, 4):
        for chunk in (1, None) if quick else (1, 4, None):
            with ProcessPoolExecutor(1, get_context("spawn")) as process:
                step = process.submit(measure, panoramas, chunk, level).result()
            name = f"{panoramas} panoramas, images_per_chunk={chunk or 'null'}"
            print(f"  {name:<44}{step.mebibytes:>8.0f} MiB{step.seconds:>8.2f} s per step")


def measure(panoramas: int, images_per_chunk: int | None, level: int) -> Step:
    """Train a few steps in this process."""
    warnings.simplefilter("ignore")
    logging.getLogger("lightning.pytorch").setLevel(logging.ERROR)
    side = 2**level
    generator = torch.Generator().manual_seed(0)
    images = torch.randn(panoramas, IMAGES, 4, side, side, generator=generator)
    shape = (panoramas, IMAGES, side, side)
    labels = torch.randint(0, NUM_CLASSES, shape, generator=generator, dtype=torch.uint8)
    samples: Any = [Sample(*pair) for pair in zip(images, labels, strict=True)] * 3
    task = SegmentationTask(
        UNet(4, NUM_CLASSES),
        TangentRepresentation(base_level=0, level=level),
        [str(k) for k in range(NUM_CLASSES)],
        partial(torch.optim.SGD, lr=1e-3),
        class_weights=[1.0] * NUM_CLASSES,
        images_per_chunk=images_per_chunk,
    )
    trainer = lightning.Trainer(
        accelerator="cpu",
        max_epochs=1,
        limit_val_batches=0,
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
    )
    before = peak_kib()
    start = time.perf_counter()
    trainer.fit(task, DataLoader(samples, panoramas))
    seconds = (time.perf_counter() - start) / 3
    return Step((peak_kib() - before) / 1024, seconds)


def peak_kib() -> int:
    """The peak of this process's memory so far, in KiB."""
    # Not getrusage: its peak is inherited from the process that started this one.
    status = Path("/proc/self/status").read_text()
    return int(status.partition("VmHWM:")[2].split()[0])


if __name__ == "__main__":
    main()
