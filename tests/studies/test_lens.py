"""Distorted images, against a slow sampler in float64 and OpenCV's maps."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import brentq

from studies.lens import (
    frame_points,
    lens_images,
    mean_enlargement,
    zoom_images,
)


def random_images(side: int, count: int = 2) -> NDArray[np.float32]:
    return np.random.default_rng(side).random((count, side, side), np.float32)


def slow(image: NDArray[np.float32], k1: float) -> NDArray[np.float64]:
    """Pixel by pixel, the cubic's root by bisection, taps one at a time."""
    side = len(image)
    result = np.zeros((side, side))
    for i in range(side):
        for j in range(side):
            x, y = (2 * j + 1) / side - 1, (2 * i + 1) / side - 1
            radius = np.hypot(x, y)
            true = brentq(lambda r, at=radius: r + k1 * r**3 - at, 0, 2, xtol=1e-14)
            scale = true / radius if radius else 1.0
            u, v = (x * scale + 1) * side / 2 - 0.5, (y * scale + 1) * side / 2 - 0.5
            for row in range(side):
                for column in range(side):
                    weight = max(0, 1 - abs(v - row)) * max(0, 1 - abs(u - column))
                    result[i, j] += weight * float(image[row, column])
    return result


@pytest.mark.parametrize("side", [7, 8])
@pytest.mark.parametrize("k1", [0.0, 0.13, 0.5])
def test_every_pixel_agrees_with_the_slow_sampler(side: int, k1: float) -> None:
    images = random_images(side)
    expected = [slow(image, k1) for image in images]
    np.testing.assert_allclose(lens_images(images, k1), expected, atol=1e-6)


def test_none_is_the_image_itself() -> None:
    images = random_images(28, 3)
    np.testing.assert_array_equal(lens_images(images, 0.0), images)
    np.testing.assert_array_equal(zoom_images(images, 0.0), images)


def test_opencv_undoes_it() -> None:
    """cv2.undistort, with the camera whose pixels are those of `frame_points`."""
    side, k1 = 61, 0.3
    y, x = np.moveaxis(frame_points(side), -1, 0)
    smooth = np.exp(-4 * ((x - 0.2) ** 2 + (y + 0.1) ** 2)).astype(np.float32)
    camera = np.array([[side / 2, 0, (side - 1) / 2], [0, side / 2, (side - 1) / 2], [0, 0, 1]])
    (distorted,) = lens_images(smooth[None], k1)
    restored = cv2.undistort(distorted, camera, np.array([k1, 0, 0, 0]))
    inner = np.hypot(x, y) < 0.7  # whose images are inside the frame
    assert np.abs(distorted - smooth)[inner].max() > 0.1
    np.testing.assert_allclose(restored[inner], smooth[inner], atol=6e-3)


def test_opencvs_map_is_the_inverse_of_ours() -> None:
    side, k1 = 31, 0.4
    camera = np.array([[side / 2, 0, (side - 1) / 2], [0, side / 2, (side - 1) / 2], [0, 0, 1]])
    lens = np.array([k1, 0, 0, 0])
    u, v = cv2.initUndistortRectifyMap(camera, lens, None, camera, (side, side), cv2.CV_32FC1)
    ramp = np.broadcast_to(np.arange(side, dtype=np.float32), (side, side))
    sampled = lens_images(np.stack([ramp, ramp.T]), k1)
    # Our image of a ramp says where each pixel comes from; there OpenCV's map leads back.
    for i, j in ((15, 15), (4, 9), (27, 20), (0, 15)):
        at = [np.full((1, 1), value, np.float32) for value in sampled[:, i, j]]
        pair = [cv2.remap(m, at[0], at[1], cv2.INTER_LINEAR) for m in (u, v)]
        np.testing.assert_allclose(np.ravel(pair), (j, i), atol=0.05)


def test_it_is_a_pincushion() -> None:
    """A straight line beside the middle bends outwards at its ends."""
    line = np.zeros((1, 56, 56), np.float32)
    line[0, 14:42, 40] = 1
    (bent,) = lens_images(line, 0.5)
    columns = np.arange(56)
    middle, end = ((bent[row] @ columns) / bent[row].sum() for row in (28, 14))
    assert 40 < middle < end


def test_the_zoom_enlarges_about_the_middle() -> None:
    dot = np.zeros((1, 57, 57), np.float32)
    dot[0, 28, 48] = 1
    (zoomed,) = zoom_images(dot, 0.5)
    found = (zoomed.sum(axis=0) @ np.arange(57)) / zoomed.sum()
    assert found - 28 == pytest.approx(20 * mean_enlargement(0.5), abs=0.1)


def test_the_enlargement_is_the_lens_mean_over_the_digits() -> None:
    points = frame_points(28 * 20)
    body = points[np.abs(points).max(axis=-1) < 20 / 28]
    expected = np.mean(1 + 0.5 * (body**2).sum(axis=-1))
    assert mean_enlargement(0.5) == pytest.approx(expected, rel=1e-4)
