"""Depth files, points and pictures of predicted depth, without a network."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from tangent_train.geometry import camera_matrix_from_fov, equirect_directions
from tangent_train.heads import DistanceHead, PredictedImage
from tangent_train.heads.distance import points_of, spread_pixels
from tangent_train.inference.images import InputImage
from tangent_train.io.gpano import read_area
from tangent_train.io.palette import UNKNOWN_COLOR, distance_colors
from tangent_train.io.pixel_files import most_depth_m, read_depth_m, write_depth_m

RNG = np.random.default_rng(0)


def _panorama(depth: NDArray[np.float32]) -> PredictedImage:
    rgb = RNG.integers(0, 256, (*depth.shape, 3), np.uint8)
    return PredictedImage(InputImage(rgb, area=read_area(Path("image"), depth.shape)), depth)


def test_points_are_evenly_spread_over_the_sphere() -> None:
    """A cap of angle a has the share (1 − cos a) / 2 of the sphere, around any direction."""
    depth = np.ones((512, 1024), np.float32)
    points, _ = points_of(_panorama(depth), spread_pixels(_panorama(depth), 20000))
    assert 19990 < len(points) <= 20000
    for axis in ((0, 0, 1), (0, 0, -1), (1, 0, 0), (-1, 0, 0), (0.6, 0, 0.8)):
        for angle in (10, 45):
            share = (points @ axis > math.cos(math.radians(angle))).mean()
            expected = (1 - math.cos(math.radians(angle))) / 2
            assert share == pytest.approx(expected, rel=0.05 if angle == 10 else 0.01)


def test_points_are_rays_times_depth_without_unknown_pixels() -> None:
    """A part across the seam has its place on the sphere; a photo is in camera axes, z ahead."""
    rgb = RNG.integers(0, 256, (64, 128, 3), np.uint8)
    depth = RNG.uniform(0.5, 9, (16, 32)).astype(np.float32)
    depth[RNG.random(depth.shape) < 0.3] = np.nan
    area = read_area(Path("image"), depth.shape, [135, -135, 0, 45])
    part = PredictedImage(InputImage(rgb, area=area), depth)
    rows, columns = pixels = spread_pixels(part, 10**6)
    assert np.isfinite(depth).sum() == len(rows) == len({*zip(rows, columns, strict=True)})
    assert np.isfinite(depth[rows, columns]).all()
    points, colors = points_of(part, pixels)
    place = 16 + rows, (112 + columns) % 128
    ahead_left_up = equirect_directions((64, 128))[place] * (1, -1, 1)
    np.testing.assert_allclose(points, ahead_left_up * depth[rows, columns, None], rtol=1e-6)
    np.testing.assert_array_equal(colors, rgb[place])
    assert spread_pixels(part._replace(pixels=np.full_like(depth, np.nan)), 100).shape == (2, 0)
    camera = camera_matrix_from_fov(90.0, (64, 128))
    photo = PredictedImage(InputImage(rgb, camera_matrix=camera), np.full((64, 128), 3.0))
    points, _ = points_of(photo, np.array([[0], [127]]))
    np.testing.assert_allclose(points, [[3 * 127 / 128, -3 * 63 / 128, 3]])


def test_solid_angles_of_a_photo_sum_to_that_of_its_pyramid() -> None:
    camera, size = camera_matrix_from_fov(120.0, (300, 400)), (300, 400)
    image = InputImage(np.zeros((*size, 3), np.uint8), camera_matrix=camera)
    angles = PredictedImage(image, np.ones(size)).solid_angles
    across = math.tan(math.radians(60))  # half of the picture's width at distance 1
    down = across * 300 / 400
    pyramid = 4 * math.asin(across * down / math.hypot(1, across) / math.hypot(1, down))
    assert angles.sum() == pytest.approx(pyramid, rel=1e-4)


def test_depth_files_are_read_back(tmp_path: Path) -> None:
    """At the limits of 16 bits: 65535 means missing, and 0 would."""
    meters = np.array([[np.nan, 1e-5, 0.0014, 1.0, 65.534, 65.5344, 65.5346, 1e4]], np.float32)
    write_depth_m(tmp_path / "a.png", meters, 1000)
    found = read_depth_m(tmp_path / "a.png", 1000)
    np.testing.assert_allclose(found, [[0, 0.001, 0.001, 1, 65.534, 65.534, 0, 0]], atol=1e-6)
    assert most_depth_m(".png", 1000) == 65.534
    for suffix in (".npy", ".exr"):
        write_depth_m(tmp_path / f"a{suffix}", meters, 1000)
        found = read_depth_m(tmp_path / f"a{suffix}", 1000)
        np.testing.assert_array_equal(found, np.nan_to_num(meters))


def test_a_video_has_one_range_of_colors() -> None:
    """That of all frames, so that a distance has the same color in all of them."""
    head = DistanceHead()
    frames = [_panorama(np.full((8, 16), m, np.float32)) for m in (1, 4, np.nan, 9)]
    everywhere = np.array(True)
    summaries = [head.summarize(frame, everywhere) for frame in frames]
    assert [summary.get("median") for summary in summaries] == [1, 4, None, 9]
    limits = head.limits(summaries)
    painted = [head.paint("color", f.image.rgb, f.pixels, limits)[0, 0] for f in frames]
    assert (painted[0] == distance_colors()[0]).all()
    place = 255 * math.log(4) / math.log(9 * 1.01)
    assert (painted[1] == distance_colors()[round(place)]).all()
    assert (painted[2] == UNKNOWN_COLOR).all()
    (row,) = head.table(summaries[2:3])[2]
    assert row == ["known pixels, % of the solid angle", "0"]
