from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tangent_train.geometry import equirect_directions
from tangent_train.rendering.upright.cues import cues, up_probabilities
from tangent_train.rendering.upright.line_segments import LineSegments, find_line_segments
from tests.rendering.drawn_room import draw_room

_NO_SEGMENTS = LineSegments(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))


def test_names_and_signs_of_the_axes_do_not_matter() -> None:
    room = draw_room((128, 256), np.eye(3))
    segments = find_line_segments(room)
    expected = up_probabilities(room, segments, np.eye(3))
    np.testing.assert_allclose(expected.sum(), 1)
    assert expected.argmax() == 2
    # Column j of the new axes is `sign` times axis `order[j]`.
    order, sign = [1, 2, 0], np.array([1, -1, -1])
    found = up_probabilities(room, segments, np.eye(3)[:, order] * sign)
    place = np.array([one + (0 if s > 0 else 3) for one, s in zip(order, sign, strict=True)])
    np.testing.assert_allclose(found, expected[[*place, *(place + 3) % 6]], rtol=1e-9)


def _lit(from_xyz: NDArray[np.float64]) -> NDArray[np.uint8]:
    bright = equirect_directions((64, 128)) @ from_xyz > 0
    return np.repeat(np.where(bright, 220, 40).astype(np.uint8)[..., None], 3, axis=-1)


def test_light_comes_from_above() -> None:
    for axis in range(3):
        even, odd = cues(_lit(np.eye(3)[axis]), _NO_SEGMENTS, np.eye(3))
        np.testing.assert_array_equal(even, 0)
        np.testing.assert_array_equal(odd[:, :2], 0)
        # Half of the sphere at 220, half at 40: they differ by two standard deviations.
        np.testing.assert_allclose(odd[:, 2], 2 * np.eye(3)[axis], atol=0.02)
        assert up_probabilities(_lit(np.eye(3)[axis]), _NO_SEGMENTS, np.eye(3)).argmax() == axis


def test_what_is_measured_of_segments() -> None:
    level = np.radians([0, 90, 180, 270])
    around = np.stack([np.cos(level), np.sin(level), np.zeros(4)], axis=-1)
    middles = np.concatenate([around, [[0, 0, -1.0], [0.6, 0, -0.8]]])
    upright = np.stack([-np.sin(level), np.cos(level), np.zeros(4)], axis=-1)
    oblique = np.array([[1, 1, 1], [2, 3, -4]]) / np.array([[3**0.5], [29**0.5]])
    segments = LineSegments(np.concatenate([upright, oblique]), middles, np.full(6, 0.2))
    image = np.full((64, 128, 3), 90, np.uint8)
    even, odd = cues(image, segments, np.eye(3))
    # The planes of the four hold the vertical, and a level axis as well: each counts once.
    assert even.shape == (3, 5)
    np.testing.assert_allclose(even[:, 0].sum(), 1)
    np.testing.assert_allclose(even[2, 1], 4 / 6)
    np.testing.assert_allclose(even[2, 2], (1 / 6) / 0.15)
    np.testing.assert_allclose(odd[2, 1], -0.9)  # clutter, at −1 and −0.8
    np.testing.assert_allclose(odd[:, 2], 0, atol=1e-12)
