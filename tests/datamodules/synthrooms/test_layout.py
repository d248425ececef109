from __future__ import annotations

import numpy as np
import pytest

from datamodules.synthrooms.layout import FloorPlan, Rectangle

L_SHAPE = FloorPlan((6.0, 5.0, 2.8), notch=(2.0, 1.5))


@pytest.mark.parametrize(
    ("plan", "area", "walls"),
    [(FloorPlan((6.0, 5.0, 2.8)), 30.0, 4), (L_SHAPE, 27.0, 6)],
)
def test_walls_go_around_the_floor_once_with_the_room_on_their_left(
    plan: FloorPlan, area: float, walls: int
) -> None:
    assert plan.floor_area == pytest.approx(area)
    assert len(plan.walls) == walls
    starts = np.array([wall.frame[:2] for wall in plan.walls])
    ends = np.array([wall.frame.at(wall.length, 0)[:2] for wall in plan.walls])
    np.testing.assert_allclose(ends, np.roll(starts, -1, axis=0), atol=1e-12)
    for wall in plan.walls:
        inside, outside = (wall.frame.at(wall.length / 2, y) for y in (0.1, -0.1))
        assert plan.contains(Rectangle.around(inside, (0, 0), (0, 0)))
        assert not plan.contains(Rectangle.around(outside, (0, 0), (0, 0)))


@pytest.mark.parametrize("notch", [None, (2.0, 1.5)])
def test_what_stands_on_the_floor_keeps_apart_and_inside(
    notch: tuple[float, float] | None,
) -> None:
    rng = np.random.default_rng(0)
    plan = FloorPlan((6.0, 5.0, 2.8), notch)
    areas = []
    for _ in range(30):
        at_wall = plan.against_wall(rng, 1.2, 0.5, "full")
        if at_wall is not None:
            areas.append(Rectangle.around(at_wall, (-0.6, 0.6), (0.01, 0.5)))
        free = plan.in_the_open(rng, 0.8, 0.6)
        if free is not None:
            areas.append(Rectangle.around(free, (-0.4, 0.4), (-0.3, 0.3)))
    assert len(areas) > 8
    for k, area in enumerate(areas):
        assert plan.contains(area)
        assert not any(area.meets(other) for other in areas[:k])


def test_a_wall_holds_something_low_below_something_high_but_no_two_of_a_kind() -> None:
    wall = FloorPlan((4.0, 3.0, 2.5)).walls[0]
    wall.taken.append((1.0, 2.0, "low"))
    assert wall.is_free(1.0, 2.0, "high")
    assert not wall.is_free(1.9, 2.5, "low")
    assert not wall.is_free(1.9, 2.5, "full")
    assert wall.is_free(2.2, 2.5, "full")
