from __future__ import annotations

import numpy as np
import pytest

from datamodules.synthrooms.layout import FloorPlan, Rectangle


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
