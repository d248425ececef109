from __future__ import annotations

import pytest

from datamodules.core.loading import EpochSampler, sample_rng
from tangent_train.errors import SettingError


def _indices(sampler: EpochSampler) -> list[int]:
    return [index for _, index in sampler]


def test_every_sample_and_epoch_has_its_own_randomness() -> None:
    keys = [(s, e, i) for s in range(3) for e in range(3) for i in range(3)]
    draws = {sample_rng(*key).random() for key in keys}
    assert len(draws) == len(keys)
    assert sample_rng(1, 2, 3).random() == sample_rng(1, 2, 3).random()


def test_shuffled_order_is_new_every_epoch_and_reproducible() -> None:
    sampler, again = EpochSampler(20, 7, shuffle=True), EpochSampler(20, 7, shuffle=True)
    first = _indices(sampler)
    sampler.set_epoch(3)
    again.set_epoch(3)
    assert list(sampler) == list(again)
    assert {epoch for epoch, _ in sampler} == {3}
    assert sorted(first) == sorted(_indices(sampler)) == list(range(20))
    assert first != _indices(sampler) != list(range(20))
    assert _indices(EpochSampler(20, 8, shuffle=True)) != first


@pytest.mark.parametrize(("length", "world_size"), [(11, 1), (11, 2), (11, 3), (4, 3), (12, 4)])
def test_evaluation_sees_everything_once(length: int, world_size: int) -> None:
    samplers = [EpochSampler(length, 0, False, rank, world_size) for rank in range(world_size)]
    assert sorted(i for s in samplers for i in _indices(s)) == list(range(length))
    assert [len(s) for s in samplers] == [len(_indices(s)) for s in samplers]


@pytest.mark.parametrize(("length", "world_size"), [(11, 1), (11, 2), (11, 3), (12, 4)])
def test_training_gives_every_process_as_much(length: int, world_size: int) -> None:
    samplers = [EpochSampler(length, 0, True, rank, world_size) for rank in range(world_size)]
    parts = [_indices(s) for s in samplers]
    assert {len(part) for part in parts} == {length // world_size} == {len(s) for s in samplers}
    together = [i for part in parts for i in part]
    assert len(set(together)) == len(together)


def test_the_dropped_tail_changes() -> None:
    dropped = set()
    for epoch in range(10):
        parts = [EpochSampler(3, 0, True, rank, 2) for rank in range(2)]
        for sampler in parts:
            sampler.set_epoch(epoch)
        dropped |= {0, 1, 2} - {i for sampler in parts for i in _indices(sampler)}
    assert dropped == {0, 1, 2}


def test_impossible_processes() -> None:
    for shuffle in (True, False):
        with pytest.raises(SettingError, match="2 processes for 1 samples"):
            EpochSampler(1, 0, shuffle, rank=0, world_size=2)


def test_a_resumed_epoch_goes_on_behind_what_was_had() -> None:
    whole, resumed = EpochSampler(9, 3, True, 1, 2), EpochSampler(9, 3, True, 1, 2, start=(4, 3))
    for epoch in (4, 5):
        whole.set_epoch(epoch)
        if epoch > 4:  # the first time its epoch is known from the start
            resumed.set_epoch(epoch)
        assert list(resumed) == list(whole)[3 if epoch == 4 else 0 :]
        assert len(resumed) == len(whole) == 4
