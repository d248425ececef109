"""Order of the samples, on one or several processes."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from torch.utils.data import SequentialSampler, Subset

from tangent_train.errors import SettingError


class EpochSampler(SequentialSampler):
    """Yield (epoch, index) in a new random order every epoch.

    Every process gets the same number of samples, because gradients are exchanged at every step.
    Up to ``world_size - 1`` samples at the end of an epoch's order are dropped, different ones in
    every epoch.

    Lightning calls `set_epoch` by itself. It must not replace or wrap this sampler: create
    the trainer with ``use_distributed_sampler=False``. With ``overfit_batches``, it only keeps
    samplers of this base class.

    Args:
        length: Number of samples in the data set.
        seed: Seed of the order, or two of them.
        rank: Rank of this process.
        world_size: Number of processes.
        start: An epoch and the number of its samples that this process has consumed: a resumed run
            continues after them. The length stays that of a whole epoch.
        is_fixed: True to repeat epoch 0 in the order of the data set.

    Raises:
        SettingError: Fewer samples than processes.
    """

    def __init__(
        self,
        length: int,
        seed: int | tuple[int, int],
        rank: int = 0,
        world_size: int = 1,
        start: tuple[int, int] = (0, 0),
        *,
        is_fixed: bool = False,
    ) -> None:
        _check_length(length, world_size)
        super().__init__(range(length))
        self._length, self._seed, self._is_fixed = length, seed, is_fixed
        self._rank, self._world_size = rank, world_size
        self._start = start
        # Workers of a resumed run start fetching before Lightning sets the epoch.
        self._epoch = start[0]

    def set_epoch(self, epoch: int) -> None:
        """Set the epoch of the next iteration."""
        self._epoch = epoch

    def __len__(self) -> int:
        return self._length // self._world_size

    def __iter__(self) -> Iterator[Any]:
        order = np.arange(self._length)
        if not self._is_fixed:
            seed = np.random.SeedSequence(self._seed, spawn_key=(self._epoch,))
            order = np.random.default_rng(seed).permutation(self._length)
        share = order[self._rank :: self._world_size][: len(self)]
        start_epoch, consumed = self._start
        epoch = 0 if self._is_fixed else self._epoch
        for index in share[consumed if self._epoch == start_epoch else 0 :]:
            yield epoch, int(index)


def share_of_process(dataset: Any) -> Subset[Any]:
    """Return the samples of this process: process r of n gets samples r, r + n, r + 2n and so on.

    Each sample belongs to exactly one process.

    Raises:
        SettingError: Fewer samples than processes.
    """
    rank, world_size = this_process()
    _check_length(len(dataset), world_size)
    return Subset(dataset, range(rank, len(dataset), world_size))


def gathered_order(length: int, world_size: int) -> list[int]:
    """Return the indices of samples in the order in which processes contribute them.

    Args:
        length: Number of samples.
        world_size: Number of processes, each with its share, see `share_of_process`.
    """
    return [index for rank in range(world_size) for index in range(rank, length, world_size)]


def _check_length(length: int, world_size: int) -> None:
    if length < world_size:  # else the processes would wait for each other
        raise SettingError(
            "trainer.devices",
            found=f"{world_size} processes for {length} samples",
            expected="at least one sample each, in every split",
        )


def this_process() -> tuple[int, int]:
    """Return the rank of this process and the number of processes of the run."""
    distributed = torch.distributed
    if distributed.is_available() and distributed.is_initialized():
        return distributed.get_rank(), distributed.get_world_size()
    return 0, 1
