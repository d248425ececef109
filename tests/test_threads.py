"""Work in threads: its order, its bound, its errors."""

from __future__ import annotations

import time
from collections.abc import Iterator

import pytest

from tangent_train.threads import in_threads


def test_results_are_in_order_and_items_are_made_a_few_at_a_time() -> None:
    made, got = [], []

    def items() -> Iterator[int]:
        for number in range(20):
            made.append(number)
            yield number

    def work(number: int) -> int:
        time.sleep(0.002 * (number % 3))
        return number * number

    for result in in_threads(work, items(), workers=3, ahead=4):
        got.append(result)
        assert len(made) <= len(got) + 4
    assert got == [number * number for number in range(20)]
    assert list(in_threads(work, [])) == []


def test_an_interruption_comes_after_the_results_of_what_was_made_before_it() -> None:
    def items() -> Iterator[int]:
        yield from range(3)
        raise KeyboardInterrupt

    found = in_threads(lambda number: number + 1, items(), workers=2, ahead=5)
    assert [next(found) for _ in range(3)] == [1, 2, 3]
    with pytest.raises(KeyboardInterrupt):
        next(found)


def test_an_error_of_the_work_takes_the_place_of_its_result() -> None:
    done = in_threads(lambda number: 1 // (2 - number), range(9), workers=2, ahead=2)
    assert [next(done), next(done)] == [0, 1]
    with pytest.raises(ZeroDivisionError):
        next(done)
