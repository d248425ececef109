"""Distances in the viewer in a real Chromium: layers, and points from all sides."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from playwright.sync_api import Browser

from tangent_train.geometry import (
    camera_matrix_from_fov,
    equirect_directions,
    perspective_directions,
)
from tangent_train.results.html import EncodedImage, encode_image, write_report
from tangent_train.results.pictures import colorize_distance, distance_limits
from tests.results.box_room import colors_at, exit_points
from tests.slow.results.browser import OpenReport, close, opened

SIZE, PHOTO, FOV_DEG = (500, 1000), (300, 400), 80.0
CENTER = np.zeros(3)
HALF_ANGLE = math.radians(25)  # from the middle of the picture to the end of its longer side
OUTSIDE, WRONG, UNLABELED = (22, 24, 28), (214, 39, 40), (110, 110, 110)
FLAT_MESSAGE = "This browser offers no WebGL 2: images are shown flat, without points."
NO_WEBGL = """
  const open = HTMLCanvasElement.prototype.getContext;
  HTMLCanvasElement.prototype.getContext = function (kind, ...rest) {
    return kind === "webgl2" ? null : open.call(this, kind, ...rest);
  };
"""


def room(directions: NDArray[np.float64], **kwargs: Any) -> EncodedImage:
    points = exit_points(CENTER, directions)
    rgb = colors_at(points).round().astype(np.uint8)
    return encode_image("room", rgb, distance=np.linalg.norm(points, axis=-1), **kwargs)


def photo() -> EncodedImage:
    """Camera axes are right, down, ahead; the room's are ahead, right, up."""
    matrix = camera_matrix_from_fov(FOV_DEG, PHOTO)
    rays = perspective_directions(matrix, PHOTO) @ [[0, 1, 0], [0, 0, -1], [1, 0, 0]]
    return room(rays, camera_matrix=matrix, sphere=False, is_metric=False)


def truth_of(directions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Distances that differ from the room's by up to 40 %, unknown above 60°."""
    distance = np.linalg.norm(exit_points(CENTER, directions), axis=-1)
    truth: NDArray[np.float64] = distance * np.exp(0.3 * directions[..., 1])
    return np.where(directions[..., 2] > np.sin(np.radians(60)), np.nan, truth)


@pytest.fixture(scope="session")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("html") / "report.html"
    directions = equirect_directions(SIZE)
    images = [room(directions), photo(), room(directions, true_distance=truth_of(directions))]
    write_report(path, "Distances", images=images)
    return path


@pytest.fixture
def report(browser: Browser, path: Path) -> Iterator[OpenReport]:
    with opened(browser, path) as open_report:
        open_report.layer("input")
        yield open_report


def axes_of(report: OpenReport) -> tuple[float, NDArray[np.float64]]:
    """Distance of the eye from the middle, and ahead, right and up of the view, as stated."""
    text = report.text(".looking").replace("−", "-")
    found = re.fullmatch(
        r"Looking along longitude (.*)°, latitude (.*)° · (.*) (m|\(.*\)) .*", text
    )
    assert found is not None, text
    lon, lat = (math.radians(float(degrees)) for degrees in found.groups()[:2])
    level = np.array([math.cos(lon), math.sin(lon), 0])
    up = np.array([0, 0, 1.0])
    ahead = math.cos(lat) * level + math.sin(lat) * up
    right = np.array([-math.sin(lon), math.cos(lon), 0])
    return float(found[3]), np.stack([ahead, right, math.cos(lat) * up - math.sin(lat) * level])


def seen(report: OpenReport, middle: Any) -> NDArray[np.float64]:
    """Points of the room in the pixels of the picture, if the view turns around `middle`."""
    away, axes = axes_of(report)
    height, width = report.pixels().shape[:2]
    half = max(height, width) / 2
    right, up = np.meshgrid(
        np.arange(width) + 0.5 - width / 2, height / 2 - np.arange(height) - 0.5
    )
    plane = np.stack([np.ones_like(right), right, up], axis=-1)
    plane[..., 1:] *= math.tan(HALF_ANGLE) / half
    return exit_points(np.asarray(middle) - away * axes[0], plane @ axes)


def check(report: OpenReport, middle: Any, points: NDArray[np.float64] | None = None) -> None:
    """Every pixel shows the color of the place where its ray leaves the room, or nothing."""
    points = seen(report, middle) if points is None else points
    is_room = np.isfinite(points[..., :1])
    assert 0.15 < is_room.mean() < 0.95, "the room and its surroundings are in the picture"
    close(report.pixels(), np.where(is_room, colors_at(points), OUTSIDE), but=0.02)


def middle_of(number: int, path: Path) -> NDArray[np.float64]:
    centers = re.findall(r'"center":\[(.*?)\]', path.read_text())
    return np.array([float(value) for value in centers[number].split(",")])


def test_walls_are_straight_from_three_sides_and_from_inside(
    report: OpenReport, path: Path
) -> None:
    report.page.locator(".points").click()
    report.drawn()
    middle = middle_of(0, path)
    assert report.text(".looking").startswith("Looking along longitude 30.0°, latitude −30.0° · ")
    check(report, middle)
    half = max(report.box()[2:]) / 2
    report.drag(120 / 90 * half, 0)
    assert "longitude 150.0°, latitude −30.0°" in report.text(".looking")
    check(report, middle)
    report.drag(90 / 90 * half, -50 / 90 * half)
    assert "longitude 240.0°, latitude 20.0°" in report.text(".looking")
    check(report, middle)
