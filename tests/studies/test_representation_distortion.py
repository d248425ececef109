"""Distortion of representations: closed forms, pixels, and sums over a panorama agree."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from studies.distortion_picture import distortion_maps
from studies.measured import measure_equirect, measure_grid
from studies.representation_distortion import (
    closed_form,
    representation_distortion,
)
from tangent_train.geometry import (
    CubeGrid,
    PinholeGrid,
    TangentGrid,
    equirect_solid_angles,
    random_rotation,
)


@pytest.fixture(scope="module")
def rows() -> dict[str, dict[str, Any]]:
    found = representation_distortion(64)
    names = [column.key for column in found.columns]
    return {row[0]: dict(zip(names, row, strict=True)) for row in found.rows}


def test_every_representation_has_a_row(rows: dict[str, dict[str, Any]]) -> None:
    assert list(rows) == ["ERP", "cube", *(f"b = {b}" for b in range(5))]
    assert [row["images"] for row in rows.values()] == [1, 6, 20, 80, 320, 1280, 5120]
    means = [row["angle_mean_deg"] for row in rows.values()]
    assert means == sorted(means, reverse=True)


def test_pixels_agree_with_closed_forms(rows: dict[str, dict[str, Any]]) -> None:
    """Means to half a percent; extremes where pixel centres are, a little inside the corners."""
    for row in rows.values():
        for name in ("angle_mean{}_deg", "area_mean{}_percent"):
            measured = row[name.format("_measured")]
            assert measured == pytest.approx(row[name.format("")], rel=7e-3), row
        assert row["area_least_measured"] == pytest.approx(row["area_least"], rel=2e-3)
        assert row["angle_worst_measured_deg"] < 1.002 * row["angle_worst_deg"]
        assert row["area_greatest_measured"] < 1.002 * row["area_greatest"]
        if row["representation"] != "ERP":
            assert row["angle_worst_measured_deg"] > 0.9 * row["angle_worst_deg"]
            assert row["area_greatest_measured"] > 0.95 * row["area_greatest"]


def test_a_cube_is_worst_in_its_corners(rows: dict[str, dict[str, Any]]) -> None:
    """There cos θ = 1/√3: scales 3 and √3; mean scale of areas 24/4π."""
    corner = math.degrees(2 * math.asin((3 - math.sqrt(3)) / (3 + math.sqrt(3))))
    assert rows["cube"]["angle_worst_deg"] == pytest.approx(corner)
    assert rows["cube"]["area_greatest"] == pytest.approx(3 * math.sqrt(3) / (6 / math.pi))
    assert rows["cube"]["area_least"] == pytest.approx(math.pi / 6)


def test_tangent_images_are_worst_in_the_icosahedrons_vertices(
    rows: dict[str, dict[str, Any]],
) -> None:
    """37.377° from the centre of a face; 2 asin(tan²(θ/2))."""
    angle = math.acos(math.sqrt((5 + 2 * math.sqrt(5)) / 15))
    expected = math.degrees(2 * math.asin(math.tan(angle / 2) ** 2))
    assert rows["b = 0"]["angle_worst_deg"] == pytest.approx(expected)


def test_the_panorama_has_no_bounds(rows: dict[str, dict[str, Any]]) -> None:
    erp = rows["ERP"]
    assert (erp["angle_worst_deg"], erp["area_greatest"]) == (180, math.inf)
    # The northmost row of 128: scale 1/cos φ over its mean π/2.
    northmost = 2 / math.pi / math.cos(math.radians(90 - 180 / 256))
    assert erp["area_greatest_measured"] == pytest.approx(northmost, rel=2e-3)


@pytest.mark.parametrize("grid", [None, CubeGrid(16), TangentGrid(0, 5), TangentGrid(2, 7)])
def test_maps_hold_the_same_distortion(grid: PinholeGrid | None) -> None:
    shape = (256, 512)
    angle, area = distortion_maps(grid, shape)
    weights = np.broadcast_to(equirect_solid_angles(shape)[:, None], shape)
    relative = area / np.average(area, weights=weights)
    mean_angle = math.degrees(np.average(angle, weights=weights))
    deviation = np.average(np.abs(relative - 1), weights=weights)
    if grid is None:
        measured = measure_equirect(shape)
        expected = (math.degrees(measured.mean_angle_rad), measured.mean_area_deviation)
    else:
        closed = closed_form(grid)
        expected = (closed.angle_mean_deg, closed.area_mean)
    assert (mean_angle, deviation) == pytest.approx(expected, rel=2e-3)
    assert (angle >= 0).all()
    assert area.min() >= 1


def test_pixels_of_all_images_share_the_sphere() -> None:
    for grid in (CubeGrid(33), TangentGrid(0, 6), TangentGrid(1, 7)):
        measured = measure_grid(grid, range(grid.num_images))
        assert measured.solid_angle.sum() == pytest.approx(4 * math.pi, rel=2e-3)


def test_a_turned_grid_is_measured_alike() -> None:
    """Wherever the seam and the poles of the panorama fall in its images."""
    grid = TangentGrid(1, 7)
    turned = grid.with_rotation(random_rotation(np.random.default_rng(5)))
    faces = range(grid.num_images)
    plain, other = measure_grid(grid, faces), measure_grid(turned, faces)
    assert other.mean_angle_rad == pytest.approx(plain.mean_angle_rad, rel=1e-6)
    assert other.worst_angle_rad == pytest.approx(plain.worst_angle_rad, rel=1e-6)
    assert other.area_range == pytest.approx(plain.area_range, rel=1e-6)
