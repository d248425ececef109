from __future__ import annotations

import numpy as np
import pytest

from tangent_train.errors import SettingError
from tangent_train.geometry import (
    SphereArea,
    equirect_directions,
    equirect_solid_angles,
    random_rotation,
)


@pytest.mark.parametrize(
    "angles",
    [(-180, 180, -36, 36), (30, 150, -20, 60), (136, -134, -90, 10), (-180, 180, -90, 90)],
)
@pytest.mark.parametrize("seed", [None, 0, 1])
def test_an_area_contains_what_is_between_its_edges(
    angles: tuple[float, ...], seed: int | None
) -> None:
    """Against comparisons of degrees, column by column, and a sum over pixels."""
    west, east, south, north = angles
    rotation = None if seed is None else random_rotation(np.random.default_rng(seed))
    area = SphereArea.of(angles).rotated(rotation)
    shape = (90, 180)
    longitudes, latitudes = 2 * np.arange(180) - 179, 89 - 2 * np.arange(90)
    beyond = longitudes + 360 * (longitudes < west)
    columns = beyond < (east if east > west else east + 360)
    rows = (latitudes > south) & (latitudes < north)
    expected = rows[:, None] & columns
    directions = equirect_directions(shape)
    moved = directions if rotation is None else directions @ rotation.T
    np.testing.assert_array_equal(area.contains(moved), expected)
    share = (expected * equirect_solid_angles(shape)[:, None]).sum() / (4 * np.pi)
    assert area.share == pytest.approx(share, abs=0.01)
    assert area.is_whole == (angles == (-180, 180, -90, 90))


@pytest.mark.parametrize("step_deg", [5, 1.7])
def test_directions_lie_in_the_area_and_leave_no_gap(step_deg: float) -> None:
    area = SphereArea(170, -150, -10, 25).rotated(random_rotation(np.random.default_rng(2)))
    lattice, steradians = area.lattice(step_deg)
    assert steradians.sum() == pytest.approx(4 * np.pi * area.share, rel=1e-3)
    inner = SphereArea(170.01, -150.01, -9.99, 24.99, area.rotation)
    assert area.rotated(np.eye(3)).contains(lattice * (1 - 1e-9)).mean() > 0.6
    assert inner.contains(lattice).mean() > 0.5
    everywhere = equirect_directions((180, 360)).reshape(-1, 3)
    inside = everywhere[area.contains(everywhere)]
    nearest = (inside @ lattice.T).max(axis=1)
    assert np.degrees(np.arccos(nearest.clip(-1, 1))).max() <= step_deg


@pytest.mark.parametrize(
    ("angles", "expected"),
    [
        ((-180, 180, -90), r"\[-180, 180, -90\]; expected \[west,east,south,north\]"),
        ((0, 181, -90, 90), "−180 to 180"),
        ((0, 90, 20, 20), "south below north"),
        ((0, 90, 30, 20), "south below north"),
        ((180, -180, 0, 10), "east other than west"),
        ((0, 90, float("nan"), 20), "−90 to 90"),
    ],
)
def test_angles_that_are_not_those_of_an_area_are_refused(
    angles: tuple[float, ...], expected: str
) -> None:
    with pytest.raises(SettingError, match=rf"data\.area: found .*{expected}"):
        SphereArea.of(angles, "data.area")
