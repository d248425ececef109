"""Crops of photos against slow float64 references."""

from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from tangent_train.rendering import PerspectiveRepresentation
from tests.geometry.paper_camera import normalizing_homography

SIZE = (90, 140)
K = np.array([[150.0, 0, 66.3], [0, 145.0, 47.1], [0, 0, 1]])


def _photo() -> NDArray[np.uint8]:
    """Smooth noise, so that interpolation is well defined."""
    noise = np.random.default_rng(0).integers(0, 256, (*SIZE, 3)).astype(np.uint8)
    smooth: NDArray[Any] = cv2.GaussianBlur(noise, (0, 0), 1.5)
    return cv2.normalize(smooth, smooth.copy(), 0, 255, cv2.NORM_MINMAX).astype(np.uint8)


def _triangle(image: NDArray[np.uint8], homography: NDArray[np.float64], side: int) -> NDArray[Any]:
    """Every pixel of a crop in float64: a weighted mean over a triangle around its place.

    The triangle is as wide as two pixels of the crop, at least two of the photo: then it is
    bilinear interpolation.
    """
    old_from_new = np.linalg.inv(homography)
    weights = []
    for axis, count in enumerate(image.shape[1::-1]):
        places = old_from_new[axis, axis] * np.arange(side) + old_from_new[axis, 2]
        away = np.abs(np.arange(count) - places[:, None])
        weight = np.maximum(0, 1 - away / max(old_from_new[axis, axis], 1))
        weights.append(weight / weight.sum(axis=1, keepdims=True))
    across, down = weights
    return np.einsum("ih,hwc,jw->ijc", down, image.astype(np.float64), across, optimize=True)


@pytest.mark.parametrize("dim", [9, 64])
@pytest.mark.parametrize("fov_deg", [17.3, 30.0])
def test_crops_agree_with_the_slow_reference(dim: int, fov_deg: float) -> None:
    photo = _photo()
    sampler = PerspectiveRepresentation(7, fov_deg, dim, crops_per_photo=3).of_camera(K, SIZE)
    crops = sampler.sample(np.random.default_rng(1))
    rendered = crops.render(photo, "bilinear")
    assert rendered.shape == (3, dim, dim, 3)
    assert rendered.dtype == np.uint8
    for box, image in zip(crops.boxes, rendered, strict=True):
        shift = (box[:2] + box[2:]) / 2 - K[:2, 2] - 0.5
        homography = normalizing_homography(K, fov_deg, (dim, dim), shift)
        assert np.abs(image - _triangle(photo, homography, dim)).max() < 1.01


def test_labels_come_from_the_pixel_at_the_center() -> None:
    labels = np.random.default_rng(0).integers(0, 14, SIZE).astype(np.uint8)
    depth = labels.astype(np.uint16) * 300
    crops = (
        PerspectiveRepresentation(6, 30.0, 16).of_camera(K, SIZE).sample(np.random.default_rng(3))
    )
    (left, top, right, bottom) = crops.boxes[0]
    rendered = crops.render(labels, "nearest")
    for i, j in np.ndindex(16, 16):
        row = math.floor(top + (i + 0.5) * (bottom - top) / 16)
        column = math.floor(left + (j + 0.5) * (right - left) / 16)
        assert rendered[0, i, j] == labels[row, column]
    np.testing.assert_array_equal(crops.render(depth, "nearest"), rendered.astype(np.uint16) * 300)


@settings(max_examples=30, deadline=None)
@given(
    focal=st.tuples(st.floats(60, 900), st.floats(60, 900)),
    size=st.tuples(st.integers(64, 800), st.integers(64, 800)),
    off_center=st.tuples(st.floats(-0.2, 0.2), st.floats(-0.2, 0.2)),
    share=st.floats(0.05, 1),
    level=st.integers(4, 9),
    overlap=st.sampled_from([0.0, 0.25, 0.6]),
    seed=st.integers(0, 100),
)
def test_crops_stay_inside_the_photo_and_count_each_pixel_once(
    focal: tuple[float, float],
    size: tuple[int, int],
    off_center: tuple[float, float],
    share: float,
    level: int,
    overlap: float,
    seed: int,
) -> None:
    height, width = size
    matrix = np.array([
        [focal[0], 0, width * (0.5 + off_center[0])], [0, focal[1], height * (0.5 + off_center[1])],
        [0, 0, 1],
    ])  # fmt: skip
    widest = min(math.atan(width / 2 / focal[0]), math.atan(height / 2 / focal[1]))
    representation = PerspectiveRepresentation(
        level, 2 * math.degrees(widest) * share * (1 - 1e-9), crops_per_photo=4
    )
    sampler = representation.of_camera(matrix, size)
    random, grid = sampler.sample(np.random.default_rng(seed)), sampler.cover(overlap)
    extent = 2 * np.diag(matrix)[:2] * math.tan(math.radians(representation.fov_deg) / 2)
    for crops in (random, grid):
        assert (crops.boxes >= 0).all()
        assert (crops.boxes[:, 2:] <= (width, height)).all()
        sides = crops.boxes[:, 2:] - crops.boxes[:, :2]
        np.testing.assert_allclose(sides, np.broadcast_to(extent, sides.shape))
    # Together they reach from border to border, and owned pixels add up to the photo's area.
    np.testing.assert_allclose(grid.boxes[:, :2].min(axis=0), 0, atol=0.01)
    np.testing.assert_allclose(grid.boxes[:, 2:].max(axis=0), (width, height), atol=0.01)
    starts = [np.unique(grid.boxes[:, axis].round(6)) for axis in (0, 1)]
    columns, rows = map(len, starts)
    assert len(grid.boxes) == columns * rows
    for places, side, whole in zip(starts, extent, (width, height), strict=True):
        step = side * (1 - overlap)
        assert (np.diff(places) <= step + 1e-5 * side).all(), "as much overlap as wanted"
        assert (len(places) - 2) * step < whole - side + 1e-5 * side, "no more than needed"
    area = grid.owned().sum() * np.prod(extent / representation.image_size[0])
    slack = 2 * (columns + rows) * max(width, height) * max(extent) / representation.image_size[0]
    assert abs(area - width * height) <= slack
