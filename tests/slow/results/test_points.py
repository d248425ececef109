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
from tangent_train.heads.pictures import colorize_distance, distance_limits
from tangent_train.results.page import EncodedImage, encode_image, write_report
from tests.results.box_room import colors_at, exit_points
from tests.slow.results.browser import OpenReport, close, opened

SIZE, PHOTO, FOV_DEG = (500, 1000), (300, 400), 80.0
CENTER = np.zeros(3)
HALF_ANGLE = math.radians(25)  # from the middle of the picture to the end of its longer side
OUTSIDE, WRONG, UNLABELED = (22, 24, 28), (214, 39, 40), (136, 136, 136)


def room(directions: NDArray[np.float64], **kwargs: Any) -> EncodedImage:
    points = exit_points(CENTER, directions)
    rgb = colors_at(points).round().astype(np.uint8)
    is_photo = "camera_matrix" in kwargs
    depth = points[..., 0] if is_photo else np.linalg.norm(points, axis=-1)
    return encode_image("room", rgb, prediction=depth, sphere=not is_photo, **kwargs)


def photo() -> EncodedImage:
    """Camera axes are right, down, ahead; the room's are ahead, right, up."""
    matrix = camera_matrix_from_fov(FOV_DEG, PHOTO)
    rays = perspective_directions(matrix, PHOTO) @ [[0, 1, 0], [0, 0, -1], [1, 0, 0]]
    return room(rays, camera_matrix=matrix, unit="relative")


def truth_of(directions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Distances that differ from the room's by up to 40 %, unknown above 60°."""
    distance = np.linalg.norm(exit_points(CENTER, directions), axis=-1)
    truth: NDArray[np.float64] = distance * np.exp(0.3 * directions[..., 1])
    return np.where(directions[..., 2] > np.sin(np.radians(60)), np.nan, truth)


@pytest.fixture(scope="session")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("html") / "report.html"
    directions = equirect_directions(SIZE)
    images = [room(directions), photo(), room(directions, truth=truth_of(directions))]
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
    report.press(*["+"] * 8)
    inside = seen(report, middle)
    assert np.isfinite(inside).mean() > 0.97, "the eye is in the room"
    close(report.pixels(), colors_at(np.nan_to_num(inside)), but=0.04)


def test_the_readout_names_the_point_under_the_pointer(report: OpenReport, path: Path) -> None:
    report.press("p")
    points = seen(report, middle_of(0, path))
    x, y, width, height = report.box()
    for column, row in ((width / 2, height / 2), (width * 0.4, height * 0.55)):
        report.page.mouse.move(x + column, y + row)
        report.drawn()
        text = report.text(".readout").replace("−", "-")
        found = re.fullmatch(r"longitude (.*)°, latitude (.*)° · prediction: (.*) m", text)
        assert found is not None, text
        lon, lat, distance = map(float, found.groups())
        ahead, right, up = points[int(row), int(column)]
        exact = math.degrees(math.atan2(right, ahead))
        assert lon == pytest.approx(exact, abs=1)
        assert lat == pytest.approx(math.degrees(math.atan2(up, math.hypot(ahead, right))), abs=1)
        assert distance == pytest.approx(math.hypot(ahead, right, up), rel=0.02)
    report.page.mouse.move(x + 20, y + 20)
    report.drawn()
    assert report.text(".readout") == "", "nothing there"


def test_points_of_a_photo_lie_in_camera_axes(report: OpenReport, path: Path) -> None:
    report.choose(1)
    assert not report.page.locator(".scale").is_visible()
    report.press("3")
    assert report.text(".scale").split("\n")[0] == "z-depth, relative"
    report.press("1", "p")
    assert "longitude 20.0°, latitude −20.0°" in report.text(".looking")
    assert "(relative)" in report.text(".looking")
    middle = middle_of(1, path)
    points = seen(report, middle)
    fx, half_width, half_height = camera_matrix_from_fov(FOV_DEG, PHOTO)[0, 0], 200, 150
    with np.errstate(invalid="ignore"):
        across, down = (np.abs(points[..., k] / points[..., 0]) * fx for k in (1, 2))
        is_seen = (points[..., 0] > 0) & (across < half_width) & (down < half_height)
    check(report, middle, np.where(is_seen[..., None], points, np.nan))


def test_layers_show_distances_and_their_errors(report: OpenReport) -> None:
    report.choose(2)
    rows, columns = 300, 600
    directions = equirect_directions((rows, columns))
    photo = colors_at(points := exit_points(CENTER, directions))
    prediction, truth = np.linalg.norm(points, axis=-1), truth_of(directions)
    near, far = limits = distance_limits(prediction, truth)
    dark = (0.4 * photo @ [0.299, 0.587, 0.114])[..., None]
    is_known = np.isfinite(truth)[..., None]
    light = 191.25 + 0.25 * dark / 0.4
    share = np.minimum(np.abs(np.log(prediction / truth)) / math.log(1.25), 1)[..., None]
    painted = colorize_distance(prediction, limits)
    expected = {
        "truth": np.where(is_known, colorize_distance(truth, limits), dark),
        "prediction": painted,
        "error": np.where(is_known, light + share * (WRONG - light), UNLABELED),
        "overlay": 0.6 * photo + 0.4 * painted,
    }
    report.project("flat")
    width, height = report.box()[2:]
    top = (height - width / 2) / 2
    u = ((np.arange(int(width)) + 0.5) / width * columns).astype(int)
    v = ((np.arange(int(width / 2) - 4) + 2.5) / (width / 2) * rows).astype(int)
    for layer, colors in expected.items():
        report.layer(layer)
        shown = report.pixels()[round(top) + 2 :][: len(v)]
        close(shown, colors[v][:, u], but=0.03)
    report.layer("error")
    assert report.text(".scale").split("\n") == [
        "|ln(prediction / ground truth)|",
        "0",
        "0.11",
        "≥ 0.22",
    ]
    assert not report.page.locator(".errors").is_visible()
    report.layer("truth")
    title, *ends = report.text(".scale").split("\n")
    assert title == "distance, m"
    assert [float(end) for end in ends] == pytest.approx(
        [near, math.sqrt(near * far), far], rel=5e-3
    )
    report.project("inside")
    ahead = np.linalg.norm(exit_points(CENTER, np.array([1.0, 0, 0])))
    assert f"ground truth: {ahead:.2f} m · prediction: {ahead:.2f} m" in report.text(".readout")
