"""Choice of up among the six directions of a Manhattan frame, by the appearance of rooms."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tangent_train.geometry import equirect_directions, equirect_solid_angles
from tangent_train.rendering.upright.line_segments import LineSegments
from tangent_train.rendering.upright.manhattan import followed_axes, segment_weights

_SMALL = (32, 64)
_BELT = 0.5
_CAP = 0.85
_GRAY = cv2.COLOR_RGB2GRAY

_EVEN = np.array([4.0, 4.5, -2.3, -24.0, -5.2])
"""Weights of what an axis has in common with its opposite: the share of the segments that follows
it; the share of all within 30° of the plane across it; their density within 32° of it and of its
opposite, relative to the mean; of those that follow it, how far from that plane they are (mean
squared sine), and how far from being evenly all around."""

_ODD = np.array([-3.8, -7.0, 0.35])
"""Weights of what differs: how high (mean sine) the segments are that follow this axis, and those
that follow none (clutter); by how many standard deviations its side is brighter."""


def up_probabilities(
    rgb: NDArray[np.uint8], segments: LineSegments, axes_xyz: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Probability that each direction of a frame is up, for panoramas in any orientation.

    Cues of rooms: vertical edges all around, at eye level and below; clutter below; few edges
    straight above and below; light from above. The weights were fitted to panoramas of SynthRooms.

    Args:
        rgb: ``(H, W, 3)`` panorama.
        segments: Its segments.
        axes_xyz: ``(3, 3)`` unit directions as columns.

    Returns:
        ``(6,)`` probabilities of ``±axes_xyz``: of all three columns, then of their opposites.
    """
    even, odd = cues(rgb, segments, axes_xyz)
    scores = np.concatenate([even @ _EVEN + odd @ _ODD, even @ _EVEN - odd @ _ODD])
    chances = np.exp(scores - scores.max())
    return chances / chances.sum()


def cues(
    rgb: NDArray[np.uint8], segments: LineSegments, axes_xyz: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """``(3, 5)`` even and ``(3, 3)`` odd features of the axes, in the order of their weights."""
    weights = segment_weights(segments)
    column, agreement = followed_axes(segments, axes_xyz)
    heights = segments.middles_xyz @ axes_xyz
    clutter = weights * (agreement == 0)
    light = _light(rgb, axes_xyz)
    even, odd = [], []
    for axis in range(3):
        height = heights[:, axis]
        own = weights * (agreement > 0) * (column == axis)
        across = heights[:, [(axis + 1) % 3, (axis + 2) % 3]] @ np.array([1, 1j])
        even.append(
            [
                _mean(column == axis, weights * agreement),
                _mean(np.abs(height) < _BELT, weights),
                _mean(np.abs(height) > _CAP, weights) / (1 - _CAP),
                _mean(height**2, own),
                abs(_mean(across / np.maximum(np.abs(across), 1e-9), own)),
            ]
        )
        odd.append([_mean(height, own), _mean(height, clutter), light[axis]])
    return np.array(even), np.array(odd)


def _mean(values: NDArray[Any], weights: NDArray[np.float64]) -> complex:
    return (values @ weights) / max(weights.sum(), 1e-9)


def _light(rgb: NDArray[np.uint8], axes_xyz: NDArray[np.float64]) -> NDArray[np.float64]:
    """``(3,)`` by how many standard deviations the side of each axis is brighter than the other."""
    gray = cv2.cvtColor(cv2.resize(rgb, _SMALL[::-1], interpolation=cv2.INTER_AREA), _GRAY).ravel()
    area = np.repeat(equirect_solid_angles(_SMALL), _SMALL[1]) * (gray > 0) + 1e-9
    cosines = equirect_directions(_SMALL).reshape(-1, 3) @ axes_xyz
    above, below = (np.maximum(sign * cosines, 0) ** 2 * area[:, None] for sign in (1, -1))
    difference = gray @ above / above.sum(axis=0) - gray @ below / below.sum(axis=0)
    spread: NDArray[np.float64] = np.sqrt(np.cov(gray, aweights=area))
    return difference / max(1.0, float(spread))
