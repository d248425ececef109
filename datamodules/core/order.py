"""Order of the images, and the random generator of each sample.

Everything random about a sample is drawn from a generator seeded by (seed, epoch, index), so a
run draws the same faces for any number of workers, and after a resume. The epoch travels with
the index, from the sampler to the workers: persistent workers need not be told about it.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from torch.utils.data import Sampler

from tangent_train.errors import SettingError

__all__ = ["EpochSampler", "Seed", "sample_rng"]


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
