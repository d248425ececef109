"""Loaders of samples: order and random numbers."""

from __future__ import annotations

from collections.abc import Iterator, Sized
from typing import Any

import cv2
import numpy as np
import torch
from torch.utils.data import DataLoader, Dataset, Sampler, SequentialSampler, Subset

from tangent_train.errors import SettingError

Seed = int | tuple[int, int]
"""A seed, 0 or more, or two of them; (seed, 0) is the same as the seed alone."""


def sample_rng(seed: Seed, epoch: int, index: int) -> np.random.Generator:
    """Random generator of one sample.

    Args:
        seed: Seed of the run.
        epoch: Epoch, from 0.
        index: Index of the sample in its data set.
    """
    # A spawn key, not a longer seed: NumPy pads short seeds with zeros, so [1, 2] is [1, 2, 0].
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(epoch, index)))


def sample_key(key: int | tuple[int, int], length: int) -> tuple[int, int]:
    """Return epoch and index of a sample; an index alone means epoch 0.

    Args:
        key: Index of a data set, negative from its end; or an epoch and an index.
        length: Number of samples.

    Raises:
        IndexError: The index is out of range.
    """
    epoch, index = key if isinstance(key, tuple) else (0, key)
    return epoch, range(length)[index]


class EpochSampler(Sampler[tuple[int, int]]):
    """Yield (epoch, index) in a new random order every epoch.

    Every process gets the same number of samples, because gradients are exchanged at every step.
    Up to ``world_size - 1`` samples at the end of an epoch's order are dropped, different ones in
    every epoch.

    Lightning calls `set_epoch` by itself. It must not replace or wrap this sampler: create
    the trainer with ``use_distributed_sampler=False``.

    Args:
        length: Number of samples in the data set.
        seed: Seed of the order.
        rank: Rank of this process.
        world_size: Number of processes.
        start: An epoch and the number of its samples that this process has consumed: a resumed run
            continues after them. The length stays that of a whole epoch.

    Raises:
        SettingError: No samples, or fewer samples than processes.
    """

    def __init__(
        self,
        length: int,
        seed: Seed,
        rank: int = 0,
        world_size: int = 1,
        start: tuple[int, int] = (0, 0),
    ) -> None:
        _check_length(length, world_size)
        self._length = length
        self._seed = seed
        self._rank = rank
        self._world_size = world_size
        self._start = start
        # Workers of a resumed run start fetching before Lightning sets the epoch.
        self._epoch = start[0]

    def set_epoch(self, epoch: int) -> None:
        """Set the epoch of the next iteration."""
        self._epoch = epoch

    def __len__(self) -> int:
        return self._length // self._world_size

    def __iter__(self) -> Iterator[tuple[int, int]]:
        epoch = self._epoch
        seed = np.random.SeedSequence(self._seed, spawn_key=(epoch,))
        order = np.random.default_rng(seed).permutation(self._length)
        share = order[self._rank :: self._world_size][: len(self)]
        start_epoch, consumed = self._start
        for index in share[consumed if epoch == start_epoch else 0 :]:
            yield epoch, int(index)


class ResumedOrder(SequentialSampler):
    """Order of the data set; the first epoch skips samples that a resumed run has consumed.

    Lightning keeps it with ``overfit_batches``.

    Args:
        dataset: The data set.
        consumed: Number of samples to skip.
    """

    def __init__(self, dataset: Sized, consumed: int) -> None:
        super().__init__(dataset)
        self._consumed = consumed

    def __iter__(self) -> Iterator[int]:
        first, self._consumed = self._consumed, 0
        yield from range(first, len(self))


def share_of_process(dataset: Dataset[Any]) -> Dataset[Any]:
    """Return the samples of this process: process r of n gets samples r, r + n, r + 2n and so on.

    Each sample belongs to exactly one process.

    Raises:
        SettingError: No samples, or fewer than processes.
    """
    rank, world_size = this_process()
    length = len(dataset)  # type: ignore[arg-type]
    _check_length(length, world_size)
    return dataset if world_size == 1 else Subset(dataset, range(rank, length, world_size))


def gathered_order(length: int, world_size: int) -> list[int]:
    """Return the indices of samples in the order in which processes contribute them.

    Args:
        length: Number of samples.
        world_size: Number of processes, each with its share, see `share_of_process`.
    """
    return [index for rank in range(world_size) for index in range(rank, length, world_size)]


def _check_length(length: int, world_size: int) -> None:
    if length == 0:
        raise SettingError("data", found="a split without images", expected="one or more")
    if length < world_size:
        raise SettingError(
            "trainer.devices",
            found=f"{world_size} processes for {length} samples",
            expected="at least one sample each, in every split",
            remedy="Use fewer processes.",
        )


def make_loader(
    dataset: Dataset[Any],
    batch_size: int,
    num_workers: int,
    seed: int,
    sampler: Sampler[Any] | None = None,
) -> DataLoader[Any]:
    """Return batches of samples.

    Args:
        dataset: Samples.
        batch_size: Number of samples in a batch.
        num_workers: Number of worker processes.
        seed: Seed of the loader's own random numbers.
        sampler: Order of the samples; by default that of the data set.
    """
    return DataLoader(
        dataset,
        batch_size=batch_size,
        sampler=sampler,
        # A separate generator: the loader draws seeds for its workers, which would shift dropout's.
        generator=torch.Generator().manual_seed(seed),
        num_workers=num_workers,
        persistent_workers=num_workers > 0,
        pin_memory=torch.cuda.is_available(),
        worker_init_fn=_opencv_without_threads,
    )


def this_process() -> tuple[int, int]:
    """Return the rank of this process and the number of processes of the run."""
    distributed = torch.distributed
    if distributed.is_available() and distributed.is_initialized():
        return distributed.get_rank(), distributed.get_world_size()
    return 0, 1


def _opencv_without_threads(_worker: int) -> None:
    # The workers are the parallelism; threads inside them would only fight over the cores. Not 1:
    # that waits for threads which the parent had and the forked worker does not.
    cv2.setNumThreads(0)
