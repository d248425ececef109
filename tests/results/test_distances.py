"""Distances in a report: packed without loss, in colors, and as a scene."""

from __future__ import annotations

import json
from base64 import b64decode
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from tangent_train.geometry import (
    camera_matrix_from_fov,
    equirect_directions,
    perspective_directions,
)
from tangent_train.heads.pictures import colorize_distance, distance_limits
from tangent_train.io.palette import UNKNOWN_COLOR
from tangent_train.results.page import encode_image, write_report
from tests.decoded import decoded
from tests.results.box_room import HIGHEST, LOWEST, exit_points

SIZE = (90, 180)
TO_AHEAD_RIGHT_UP = np.array([[0, 0, 1], [1, 0, 0], [0, -1, 0]])  # from camera axes


def rgb_of(size: tuple[int, ...]) -> NDArray[np.uint8]:
    return np.zeros((*size, 3), np.uint8)


def on_page(tmp_path: Path, *args: Any, **kwargs: Any) -> dict[str, Any]:
    """The only image of a page, as the viewer reads it."""
    write_report(tmp_path / "report.html", "Distances", images=[encode_image(*args, **kwargs)])
    page = (tmp_path / "report.html").read_text()
    image: dict[str, Any] = json.loads(
        page.split('<script type="application/json">')[1].split("<")[0]
    )
    return image


def unpacked(image: dict[str, Any], kind: str) -> NDArray[np.float64]:
    """Distances of a page, NaN where unknown, by the formula of `DistanceScale`."""
    near, far = image["scale"]["near"], image["scale"]["far"]
    red, green, blue = decoded(b64decode(image[kind])).astype(np.float64).transpose(2, 0, 1)
    assert not blue.any()
    value = 256 * red + green
    distances: NDArray[np.float64] = near * (far / near) ** ((value - 1) / 65534)
    return np.where(value == 0, np.nan, distances)


def test_points_of_a_panorama_lie_on_the_walls_of_the_room(tmp_path: Path) -> None:
    """The bound is half a step of the logarithm, as `DistanceScale` states."""
    directions = equirect_directions(SIZE)
    distance = np.linalg.norm(exit_points(np.zeros(3), directions), axis=-1)
    truth = np.where(directions[..., 2] > 0.9, np.nan, 1.1 * distance)
    truth[0, :3] = 0, np.inf, -1
    maps = {"prediction": distance, "truth": truth}
    image = on_page(tmp_path, "room", rgb_of(SIZE), prediction=distance, truth=truth)
    precision = (image["scale"]["far"] / image["scale"]["near"]) ** (1 / 131068) * (1 + 1e-6)
    assert precision < 1 + 2e-5
    for kind, exact in maps.items():
        ratio = unpacked(image, kind) / exact
        is_known = np.isfinite(exact) & (exact > 0)
        np.testing.assert_array_equal(np.isfinite(ratio), is_known)
        assert np.abs(np.log(ratio[is_known])).max() <= np.log(precision)
    points = unpacked(image, "prediction")[..., None] * directions
    to_walls = np.minimum(np.abs(points - LOWEST), np.abs(points - HIGHEST)).min(axis=-1)
    assert to_walls.max() <= (precision - 1) * distance.max()


def test_a_photo_shows_z_depth_and_its_points_lie_on_a_wall(tmp_path: Path) -> None:
    """Tilted by 30° towards a wall at 2 m; the map has fewer pixels than the photo."""
    size, small = (60, 80), (30, 40)
    matrix = camera_matrix_from_fov(70.0, small)
    normal = np.array([0, np.sin(np.radians(30)), np.cos(np.radians(30))])
    directions = perspective_directions(matrix, small)
    z_depth = 2 / (directions @ normal) * directions[..., 2]
    shown = {"camera_matrix": camera_matrix_from_fov(70.0, size), "sphere": False}
    image = on_page(tmp_path, "photo", rgb_of(size), prediction=z_depth, unit="relative", **shown)
    np.testing.assert_allclose(unpacked(image, "prediction"), z_depth, rtol=2e-5)
    fx, fy, cx, cy = image["scale"]["camera"]
    u, v = np.meshgrid((np.arange(40) + 0.5) / 40, (np.arange(30) + 0.5) / 30)
    rays = np.stack([(u - cx) / fx, (v - cy) / fy, np.ones(small)], axis=-1)
    np.testing.assert_allclose(z_depth[..., None] * rays @ normal, 2, rtol=2e-5)
    middle = np.array(image["scale"]["center"]) @ TO_AHEAD_RIGHT_UP
    assert middle @ normal == pytest.approx(2, rel=0.1)
    assert image["scale"]["unit"] == "relative"


@pytest.mark.parametrize("value", [np.nan, 3.0])
def test_maps_without_distances_and_of_one_distance_are_shown(value: float, tmp_path: Path) -> None:
    image = on_page(tmp_path, "wall", rgb_of(SIZE), prediction=np.full(SIZE, value))
    np.testing.assert_allclose(unpacked(image, "prediction"), value)
    assert image["scale"]["radius"] > 0
    assert image["scale"]["limits"][0] < image["scale"]["limits"][1]


def test_the_sky_does_not_move_the_scene_away(tmp_path: Path) -> None:
    directions = equirect_directions(SIZE)
    distance = np.linalg.norm(exit_points(np.zeros(3), directions), axis=-1)
    distance[:30] = 5000
    scale = on_page(tmp_path, "street", rgb_of(SIZE), prediction=distance)["scale"]
    assert (scale["center"] > LOWEST - 0.1).all()
    assert (scale["center"] < HIGHEST + 0.1).all()
    assert scale["radius"] < 0.6 * np.linalg.norm(HIGHEST - LOWEST)


def test_large_maps_without_a_camera_are_shrunk(tmp_path: Path) -> None:
    distance = np.repeat(np.linspace(1, 2, 4096)[None], 64, axis=0)
    image = on_page(tmp_path, "large", rgb_of((64, 128)), prediction=distance, sphere=False)
    assert image["scale"]["camera"] is None, "no points"
    shrunk = unpacked(image, "prediction")
    assert shrunk.shape == (32, 2048)
    np.testing.assert_allclose(shrunk, distance[::2, ::2], rtol=4e-4)


def test_near_is_bright_and_far_is_dark_in_equal_steps() -> None:
    """CIELAB's lightness falls evenly with the logarithm; unknown pixels are gray."""
    distance = np.geomspace(0.5, 8, 101)[None]
    colors = colorize_distance(distance, (0.5, 8.0))
    lightness = cv2.cvtColor(colors.astype(np.float32) / 255, cv2.COLOR_RGB2Lab)[0, :, 0]
    line = np.linspace(lightness[0], lightness[-1], 101)
    assert lightness[0] > 85 > 20 > lightness[-1]
    assert np.abs(lightness - line).max() < 3
    beyond = colorize_distance(np.array([[0.1, 100, np.nan, 0, np.inf]]), (0.5, 8.0))[0]
    np.testing.assert_array_equal(beyond, [colors[0, 0], colors[0, -1], *[UNKNOWN_COLOR] * 3])


def test_the_scale_of_several_pictures_leaves_out_rare_distances() -> None:
    maps = np.full((20, 20), 2.0), np.full((20, 20), 6.0, np.float32)
    maps[0][0, :3] = 0.01, 900, np.nan
    assert distance_limits(*maps) == (2, 6)
    np.testing.assert_array_equal(colorize_distance(maps[1]), colorize_distance(maps[1] / 2))
