"""Loaders of samples: order and random numbers, and explanations of their workers' errors."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

import cv2
import numpy as np
import torch
from torch.utils.data import DataLoader, Dataset, Sampler

from tangent_train.errors import DataError, SettingError

Seed = int | tuple[int, int]
"""A seed, 0 or more, or one with a stream; (seed, 0) is the same as the seed alone."""


def sample_rng(seed: Seed, epoch: int, index: int) -> np.random.Generator:
    """Random generator of one sample.

    Args:
        seed: Seed of the run.
        epoch: Epoch, from 0.
        index: Place of the sample in its data set.
    """
    # A spawn key, not a longer seed: NumPy pads short seeds with zeros, so [1, 2] is [1, 2, 0].
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(epoch, index)))


class EpochSampler(Sampler[tuple[int, int]]):
    """Yields (epoch, index).

    * Shuffled (training), every process gets the same number of samples, as gradients are
      exchanged at every step: the last few of the epoch's order, fewer than there are processes,
      are dropped, different ones every epoch.
    * In order (evaluation), process r gets r, r + world_size, …: every sample exactly once on any
      number of processes, nothing repeated or dropped.

    Lightning calls `set_epoch` by itself. It must not replace or wrap this sampler: create
    the trainer with ``use_distributed_sampler=False``.

    Args:
        length: Number of samples in the data set.
        seed: Seed of the order.
        shuffle: A new random order every epoch.
        rank: This process.
        world_size: Number of processes.
        start: An epoch and the number of its samples that this process has consumed: a resumed run
            continues after them. The length stays that of a whole epoch.

    Raises:
        SettingError: No samples, or fewer than processes.
    """

    def __init__(
        self,
        length: int,
        seed: Seed,
        shuffle: bool,
        rank: int = 0,
        world_size: int = 1,
        start: tuple[int, int] = (0, 0),
    ) -> None:
        if length == 0:
            raise SettingError("data", found="a split without images", expected="one or more")
        if length < world_size:
            raise SettingError(
                "trainer.devices",
                found=f"{world_size} processes for {length} samples",
                expected="at least one sample each, in every split",
                remedy="Use fewer processes.",
            )
        self._length = length
        self._seed = seed
        self._shuffle = shuffle
        self._rank = rank
        self._world_size = world_size
        self._start = start
        # Workers of a resumed run start to fetch before Lightning says the epoch.
        self._epoch = start[0]

    def set_epoch(self, epoch: int) -> None:
        """Set the epoch of the next iteration."""
        self._epoch = epoch

    def __len__(self) -> int:
        return len(range(self._rank, self._used, self._world_size))

    def __iter__(self) -> Iterator[tuple[int, int]]:
        epoch = self._epoch
        order = np.arange(self._length)
        if self._shuffle:
            order = np.random.default_rng(
                np.random.SeedSequence(self._seed, spawn_key=(epoch,))
            ).permutation(self._length)
        start_epoch, had = self._start
        mine = order[self._rank : self._used : self._world_size]
        for index in mine[had if epoch == start_epoch else 0 :]:
            yield epoch, int(index)

    @property
    def _used(self) -> int:
        return self._length - (self._length % self._world_size if self._shuffle else 0)


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
