from __future__ import annotations

import pytest

from datamodules.core.group_drawing import draw_groups

_ROOMS = [("area_1", "office", number) for number in range(20)]


@pytest.mark.parametrize(
    ("fraction", "count"), [(0.001, 1), (0.1, 2), (0.26, 5), (0.5, 10), (0.999, 19)]
)
def test_as_many_as_asked_for_but_never_none_or_all(fraction: float, count: int) -> None:
    drawn = draw_groups(_ROOMS, fraction, seed=3)
    assert len(drawn) == count
    assert drawn < set(_ROOMS)


def test_neither_order_nor_repetition_matters() -> None:
    drawn = draw_groups(_ROOMS, 0.3, seed=7)
    assert draw_groups(_ROOMS[::-1] + _ROOMS[:5], 0.3, seed=7) == drawn


@pytest.mark.parametrize("groups", [[], ["hall"], ["hall", "hall"]])
def test_nothing_is_drawn_where_nothing_would_be_left(groups: list[str]) -> None:
    assert draw_groups(groups, 0.9, seed=0) == set()
