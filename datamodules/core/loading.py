"""Loaders of samples, and explanations of their workers' errors."""

from __future__ import annotations

import re
from typing import Any

import cv2
import torch
from torch.utils.data import DataLoader, Dataset

from datamodules.core.order import EpochSampler
from tangent_train.errors import DataError, SettingError

__all__ = ["at_least", "explained", "make_loader", "this_process"]

_FEWER = (
    "Memory may be too small for as many: use fewer (0 works in the process itself), a lower "
    "level, or a store (data.store=…, data.in_memory=false); or enlarge /dev/shm (docker run "
    "--shm-size=8g)."
)
_CAUGHT = re.compile(r"\ACaught \w+ in DataLoader worker.*\.(?:Data|Setting)Error: ", re.DOTALL)


def make_loader(
    dataset: Dataset[Any], sampler: EpochSampler, batch_size: int, num_workers: int, seed: int
) -> DataLoader[Any]:
    """Batches of samples.

    Args:
        dataset: Samples by (epoch, index).
        sampler: Order of the samples.
        batch_size: Samples of a batch.
        num_workers: Worker processes.
        seed: Of the loader's own random numbers.
    """
    return DataLoader(
        dataset,
        batch_size=batch_size,
        sampler=sampler,
        # Its own: the loader draws seeds for its workers, which would shift those of dropout.
        generator=torch.Generator().manual_seed(seed),
        num_workers=num_workers,
        persistent_workers=num_workers > 0,
        pin_memory=torch.cuda.is_available(),
        worker_init_fn=_opencv_without_threads,
    )


def explained(error: Exception, num_workers: int) -> Exception:
    """Explain an error that a loader, or one of its workers, raised.

    Args:
        error: The error.
        num_workers: Of the loader.

    Returns:
        The error of a worker as raised there; a remedy if a worker was killed; or the
        same error.
    """
    text = str(error)
    died = isinstance(error, RuntimeError) and text.startswith("DataLoader worker (pid")
    if isinstance(error, ConnectionError | EOFError):  # a batch was fetched as its worker ended
        died, text = True, "DataLoader worker that ended"
    if died:
        return SettingError(
            "data.num_workers",
            found=f"{num_workers}, and a {text.partition('. ')[0]}",
            expected="workers that keep running",
            remedy=_FEWER,
        )
    if not isinstance(error, DataError | SettingError):
        return error
    message, caught = _CAUGHT.subn("", text)
    return type(error)(message.rstrip()) if caught else error


def this_process() -> tuple[int, int]:
    """Rank and number of processes of this run."""
    distributed = torch.distributed
    if distributed.is_available() and distributed.is_initialized():
        return distributed.get_rank(), distributed.get_world_size()
    return 0, 1


def _opencv_without_threads(_worker: int) -> None:
    # The workers are the parallelism; threads inside them would only fight over the cores. Not 1:
    # that waits for threads which the parent had and the forked worker does not.
    cv2.setNumThreads(0)


def at_least(name: str, value: int, least: int) -> int:
    """A setting that has to be `least` or more.

    Raises:
        SettingError: It is less.
    """
    if value < least:
        raise SettingError(name, found=value, expected=f"{least} or more")
    return value
