"""Studies of levels and fields of view, against the paper's printed numbers and geometry."""

from __future__ import annotations

import csv
import io
import math
from typing import Any

import numpy as np
import pytest

from studies.angular_resolution import (
    CAMERAS,
    PAPER_DEG,
    angular_resolution,
)
from studies.fov import fov
from studies.outcome import Outcome
from studies.surface_area import surface_area
from tangent_train.geometry import TangentGrid, icosphere, vertex_resolution


def rows_of(found: Outcome) -> list[dict[str, Any]]:
    names = [column.key for column in found.columns]
    return [dict(zip(names, row, strict=True)) for row in found.rows]


def test_surface_area_is_that_of_the_meshes() -> None:
    found = rows_of(surface_area(4))
    for row in found:
        vertices, faces = icosphere(row["level"])
        a, b, c = np.moveaxis(vertices[faces], 1, 0)
        area = np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2
        radius = np.linalg.norm(vertices, axis=1)
        sphere = 4 * math.pi
        assert row["ratio_mean_radius"] == pytest.approx(area / (sphere * radius.mean() ** 2))
        assert row["ratio_greatest_radius"] == pytest.approx(area / (sphere * radius.max() ** 2))
        assert (row["least_radius"], row["faces"]) == (pytest.approx(radius.min()), len(faces))
    on_sphere = [row["ratio_on_sphere"] for row in found]
    # An inscribed icosahedron: 5√3 a² with the edge a = 1/sin 72°.
    edge = 1 / math.sin(math.radians(72))
    assert on_sphere[0] == pytest.approx(5 * math.sqrt(3) * edge**2 / sphere)
    # "Note the leveling off after the third subdivision level."
    steps = np.diff(on_sphere)
    assert (steps > 0).all()
    assert steps[2] > 0.01 > steps[3]


def test_a_table_and_a_file_say_the_same() -> None:
    found = surface_area(2)
    lines = list(csv.DictReader(io.StringIO(found.csv())))
    assert [line["level"] for line in lines] == ["0", "1", "2"]
    for line, row in zip(lines, rows_of(found), strict=True):
        assert float(line["ratio_on_sphere"]) == row["ratio_on_sphere"]
    header, *body = found.cells()
    assert header[0] == "level"
    assert "least_radius" not in header
    assert body[0][1:3] == ("20", "0.761918")


def test_fields_of_view_are_the_papers() -> None:
    found = rows_of(fov(10))
    assert [row["base_level"] for row in found] == list(range(5))
    expected = (73.1345, 51.6162, 31.4503, 16.6995, 8.4306)
    for row, degrees in zip(found, expected, strict=True):
        assert row["between_corners_deg"] == pytest.approx(degrees, abs=5e-5)
        assert abs(row["between_corners_deg"] - row["paper_deg"]) < 0.05


def test_fields_of_view_are_angles_between_pixels() -> None:
    for row in rows_of(fov(6)):
        grid = TangentGrid(row["base_level"], 6)
        ends = grid.directions([0])[0]
        corners = math.degrees(math.acos(ends[0, 0] @ ends[0, -1]))
        assert row["between_corners_deg"] == pytest.approx(corners, abs=1e-5)
        middle = (grid.dim - 1) / 2
        points = np.array([[-middle, 0, 1 / grid.pitch], [middle, 0, 1 / grid.pitch]])
        points /= np.linalg.norm(points, axis=1, keepdims=True)
        across = math.degrees(math.acos(points[0] @ points[1]))
        assert row["across_middle_deg"] == pytest.approx(across, abs=1e-5)
        assert row["owned_deg"] < row["across_middle_edges_deg"]
        assert row["across_middle_deg"] < row["across_middle_edges_deg"]
        assert row["paper_deg"] is None  # the paper's are of level 10


def test_base_levels_without_images_are_left_out() -> None:
    assert [row["base_level"] for row in rows_of(fov(5))] == [0, 1, 2, 3]


def test_levels_are_as_fine_as_the_paper_says() -> None:
    found = rows_of(angular_resolution(10))
    levels, cameras = found[:11], found[11:]
    for row in levels:
        assert row["deg_per_pixel"] == 180 / row["rows"] == 360 / row["columns"]
        if row["level"] in PAPER_DEG:
            assert row["deg_per_pixel"] == pytest.approx(row["paper_deg_per_pixel"], abs=6e-4)
    assert [row["vertices"] for row in levels][::5] == [12, 10_242, 10_485_762]
    assert levels[10]["faces"] == 20 * 4**10
    resolution = math.degrees(vertex_resolution(5))
    assert levels[5]["vertex_resolution_deg"] == pytest.approx(resolution, rel=1e-9)
    assert levels[8]["tangent_b1_deg_per_pixel"] == pytest.approx(
        math.degrees(TangentGrid(1, 8).pitch)
    )
    assert levels[2]["tangent_b4_deg_per_pixel"] is None
    assert [row["name"] for row in cameras] == [camera.name for camera in CAMERAS]
    vga = cameras[2]
    assert vga["deg_per_pixel"] == pytest.approx(0.094, abs=5e-4) == vga["paper_deg_per_pixel"]
    # "This is most similar to a 2048 × 4096 equirectangular image."
    assert round(vga["level"]) == 10
    assert cameras[1]["level"] == pytest.approx(8)  # paper: 128² pixels at 45° for level 8
    assert cameras[0]["level"] == pytest.approx(5)
