"""Radial distortion both ways, against OpenCV and a root finder."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy.optimize import brentq

from tangent_train.errors import SettingError
from tangent_train.geometry.brown_conrady import distort, undistort

POINTS = np.concatenate([[[0.0, 0.0]], np.random.default_rng(0).uniform(-1.5, 1.5, (200, 2))])
K1 = (0.0, 1e-12, 0.05, 0.5, 4.0)


@pytest.mark.parametrize("k1", K1)
def test_each_is_the_inverse_of_the_other(k1: float) -> None:
    np.testing.assert_allclose(undistort(distort(POINTS, k1), k1), POINTS, atol=1e-14)
    np.testing.assert_allclose(distort(undistort(POINTS, k1), k1), POINTS, atol=1e-14)


@pytest.mark.parametrize("k1", K1)
def test_opencv_finds_the_same_points(k1: float) -> None:
    lens = np.array([k1, 0, 0, 0])
    rays = np.concatenate([POINTS, np.ones((len(POINTS), 1))], axis=1)
    forward, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), np.eye(3), lens)
    np.testing.assert_allclose(distort(POINTS, k1), forward[:, 0], atol=1e-13)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 1000, 1e-15)
    backward = cv2.undistortPoints(POINTS[:, None], np.eye(3), lens, criteria=criteria)
    np.testing.assert_allclose(undistort(POINTS, k1), backward[:, 0], atol=1e-12)


@pytest.mark.parametrize("k1", K1[1:])
def test_the_closed_form_is_the_root_of_the_cubic(k1: float) -> None:
    for radius in (1e-9, 0.3, 1.0, np.sqrt(2)):
        root = brentq(lambda r, at=radius: r * (1 + k1 * r * r) - at, 0, radius + 1e-9, xtol=1e-15)
        assert undistort([0, -radius], k1)[1] == pytest.approx(-root, rel=1e-9)


def test_a_pincushion_pushes_corners_farther_than_edges() -> None:
    edge, corner = distort([[1, 0], [1, 1]], 0.2)
    np.testing.assert_allclose(edge, [1.2, 0])
    np.testing.assert_allclose(corner, [1.4, 1.4])


@pytest.mark.parametrize("k1", [-0.1, float("nan"), float("inf")])
def test_coefficients_without_an_inverse_are_refused(k1: float) -> None:
    with pytest.raises(SettingError, match=r"K1: found .*expected 0 or more"):
        undistort(POINTS, k1)
    with pytest.raises(SettingError, match=r"K1: found"):
        distort(POINTS, k1)
