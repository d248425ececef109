"""The direction of up in a panorama, from its content or from the camera's pose tags."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from tangent_train.errors import SettingError
from tangent_train.geometry import equirect_directions, equirect_solid_angles, rotation_about
from tangent_train.geometry.sphere import Floats
from tangent_train.orientation.manhattan import (
    LineSegments,
    ManhattanFrame,
    find_line_segments,
    find_manhattan_frames,
    followed_axes,
    segment_weights,
)

UpLikelihood = Callable[[Floats], Floats]
"""Maps directions ``(n, 3)`` to log-likelihoods ``(n,)`` of being up, up to a constant."""

_EVEN_CHANCE = 3.1  # significance at which half of the frames are right
_STEEPNESS = 3.0
_ACCEPTED = 0.5
_HOPELESS = 1 / 400
"""Directions less likely than the best by this factor are not passed on, to save time."""
_LEAST_ROWS = 64
"""In panoramas with fewer rows, noise is mistaken for a room."""
_DISTINCT = np.cos(np.radians(6))

_SMALL = (32, 64)
_BELT = 0.5
_CAP = 0.85
_GRAY = cv2.COLOR_RGB2GRAY

_EVEN = np.array([4.0, 4.5, -2.3, -24.0, -5.2])
"""Weights of features that are equal for an axis and its opposite:

1. share of segments that follow the axis;
2. share of all segments within 30° of the plane perpendicular to it;
3. density of segments within 32° of the axis or its opposite, relative to the mean;
4. mean squared sine of the angle between that plane and the segments that follow the axis;
5. unevenness around the axis of the segments that follow it, 0 to 1.
"""

_ODD = np.array([-3.8, -7.0, 0.35])
"""Weights of features with the opposite sign for the opposite axis:

1. mean height (sine) of segments that follow the axis;
2. mean height of segments that follow no axis (clutter);
3. standard deviations by which the side of the axis is brighter than the other.
"""


def estimate_up(
    rgb: NDArray[np.uint8], max_tilt_deg: float = 60.0, likelihood: UpLikelihood | None = None
) -> Floats | None:
    """Estimate the direction of up from the straight edges of rooms and buildings.

    Most straight edges follow three directions at right angles, and one of them is the vertical.
    The frame that most edges follow (Coughlan and Yuille, "Manhattan World", ICCV 1999) provides
    these axes to a fraction of a degree. If only one axis is within `max_tilt_deg` of the
    panorama's own vertical, it is up. If several are, one is selected by the appearance of rooms
    (see `up_probabilities`), and by `likelihood` if it is given. By appearance alone, one in six
    randomly rotated SynthRooms gets a wrong axis.

    Estimates with a probability below one half are rejected, for example in nature, noise and
    images without edges.

    Args:
        rgb: ``(H, W, 3)`` uint8 whole panorama. With less than 64 rows there is no estimate; use
            128 or more. Black (0, 0, 0) areas count as missing.
        max_tilt_deg: Maximum angle of up from ``(0, 0, 1)``, above 0; 180 for all orientations.
            Choose it slightly above the camera's tilt: with a larger value, another axis of the
            room may be taken for up.
        likelihood: Other evidence about directions, such as the confidence of a network
            (`inference.engine.UpLikelihood`). It is called at most once, for the likely directions
            of the best frame.

    Returns:
        ``(3,)`` unit vector in the panorama's frame; None without an estimate.

    Raises:
        SettingError: The tilt is not above 0 and at most 180.
    """
    if not 0 < max_tilt_deg <= 180:
        raise SettingError("max_tilt_deg", found=max_tilt_deg, expected="above 0, at most 180")
    if rgb.shape[0] < _LEAST_ROWS:
        return None
    segments = find_line_segments(rgb)
    frames = find_manhattan_frames(segments)
    lowest = math.cos(math.radians(max_tilt_deg)) - 1e-9
    directions, chances = _candidates(rgb, segments, frames, lowest, likelihood)
    best = int(chances.argmax()) if len(chances) else None
    return None if best is None or chances[best] < _ACCEPTED else directions[best]


def _candidates(
    rgb: NDArray[np.uint8],
    segments: LineSegments,
    frames: list[ManhattanFrame],
    lowest: float,
    likelihood: UpLikelihood | None,
) -> tuple[Floats, Floats]:
    """Return possible directions of up ``(n, 3)`` and their probabilities ``(n,)``."""
    # A logit model over all frames and "no frame"; frames with the same vertical add up.
    odds = [math.exp(_STEEPNESS * (frame.significance - _EVEN_CHANCE)) for frame in frames]
    directions = np.zeros((0, 3))
    chances = np.zeros(0)
    for frame, odd in zip(frames, odds, strict=True):
        axes = np.concatenate([frame.axes_xyz.T, -frame.axes_xyz.T])
        inside = axes[:, 2] >= lowest
        if not inside.any():
            continue
        shares = np.ones(1)
        if inside.sum() > 1:
            shares = up_probabilities(rgb, segments, frame.axes_xyz)[inside]
            likely = shares > _HOPELESS * shares.max()
            if likelihood is not None and frame is frames[0] and likely.sum() > 1:
                evidence = likelihood(axes[inside][likely])
                shares[likely] *= np.exp(evidence - evidence.max())
                shares[~likely] = 0
        for axis, share in zip(axes[inside], odd * shares / shares.sum(), strict=True):
            known = np.flatnonzero(directions @ axis > _DISTINCT)
            if len(known):
                chances[known[0]] += share
            else:
                directions = np.concatenate([directions, axis[None]])
                chances = np.append(chances, share)
    return directions, chances / (1 + sum(odds))


def up_probabilities(rgb: NDArray[np.uint8], segments: LineSegments, axes_xyz: Floats) -> Floats:
    """Return the probability that each direction of a frame is up, for arbitrary rotations.

    Rooms have vertical edges all around, at eye level and below; clutter below; few edges straight
    above and below; light from above. The weights of these features were fitted to panoramas of
    SynthRooms.

    Args:
        rgb: ``(H, W, 3)`` panorama.
        segments: Line segments of the panorama.
        axes_xyz: ``(3, 3)`` unit directions as columns.

    Returns:
        ``(6,)`` probabilities of the three columns, then of their opposites.
    """
    even, odd = cues(rgb, segments, axes_xyz)
    scores = np.concatenate([even @ _EVEN + odd @ _ODD, even @ _EVEN - odd @ _ODD])
    chances = np.exp(scores - scores.max())
    return chances / chances.sum()


def cues(rgb: NDArray[np.uint8], segments: LineSegments, axes_xyz: Floats) -> tuple[Floats, Floats]:
    """Return ``(3, 5)`` even and ``(3, 3)`` odd features of axes, in the order of the weights."""
    weights = segment_weights(segments)
    column, agreement = followed_axes(segments, axes_xyz)
    heights = segments.middles_xyz @ axes_xyz
    clutter = weights * (agreement == 0)
    light = _light(rgb, axes_xyz)
    even, odd = [], []
    for axis in range(3):
        height = heights[:, axis]
        followers = weights * (agreement > 0) * (column == axis)
        across = heights[:, [(axis + 1) % 3, (axis + 2) % 3]] @ np.array([1, 1j])
        even.append(
            [
                _mean(column == axis, weights * agreement),
                _mean(np.abs(height) < _BELT, weights),
                _mean(np.abs(height) > _CAP, weights) / (1 - _CAP),
                _mean(height**2, followers),
                abs(_mean(across / np.maximum(np.abs(across), 1e-9), followers)),
            ]
        )
        odd.append([_mean(height, followers), _mean(height, clutter), light[axis]])
    return np.array(even), np.array(odd)


def _mean(values: NDArray[Any], weights: Floats) -> complex:
    return (values @ weights) / max(weights.sum(), 1e-9)


def _light(rgb: NDArray[np.uint8], axes_xyz: Floats) -> Floats:
    """Return how many standard deviations brighter each axis is than its opposite, ``(3,)``."""
    gray = cv2.cvtColor(cv2.resize(rgb, _SMALL[::-1], interpolation=cv2.INTER_AREA), _GRAY).ravel()
    area = np.repeat(equirect_solid_angles(_SMALL), _SMALL[1]) * (gray > 0) + 1e-9
    cosines = equirect_directions(_SMALL).reshape(-1, 3) @ axes_xyz
    above, below = (np.maximum(sign * cosines, 0) ** 2 * area[:, None] for sign in (1, -1))
    difference = gray @ above / above.sum(axis=0) - gray @ below / below.sum(axis=0)
    spread: Floats = np.sqrt(np.cov(gray, aweights=area))
    return difference / max(1.0, float(spread))


def upright_rotation(up: ArrayLike) -> Floats:
    """Return the smallest rotation R with ``R @ (0, 0, 1) = up``.

    The z axis of a grid rotated by it (``grid.with_rotation(R)``) points up, and
    ``rotate_equirect(panorama, R.T)`` returns the upright panorama.

    Args:
        up: ``(3,)`` direction of up in the panorama's frame, of any length.

    Returns:
        ``(3, 3)`` rotation; half a revolution about the y axis for ``(0, 0, -1)``.

    Raises:
        SettingError: The direction is not three finite numbers, or all are 0.

    >>> upright_rotation([0, 1, 0]).round(6).tolist()
    [[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]
    """
    direction = np.asarray(up, np.float64)
    length = np.linalg.norm(direction)
    if direction.shape != (3,) or not 0 < length < math.inf:
        raise SettingError("up", found=up, expected="three numbers, not all 0")
    x, y, z = direction / length
    sine = math.hypot(x, y)
    axis = (-y / sine, x / sine, 0) if sine > 0 else (0, 1, 0)
    return rotation_about(axis, math.atan2(sine, z))


def up_from_pose(pitch_deg: float, roll_deg: float) -> Floats:
    """Return the direction of up from `PosePitchDegrees` and `PoseRollDegrees` of a panorama.

    These are Google's Photo Sphere XMP metadata
    (https://developers.google.com/streetview/spherical-metadata). The pitch is that of the middle
    of the image, in degrees above the horizon. As the roll increases, the horizon rotates
    counterclockwise in the image and the camera's right side moves down. The camera is rotated by
    the heading, then by the pitch about its own right axis, then by the roll about its own forward
    axis; up does not depend on the heading. Some programs write or show the roll with the opposite
    sign.

    Args:
        pitch_deg: Pitch, −90 to 90.
        roll_deg: Roll, −180 to 180.

    Returns:
        ``(3,)`` unit vector in the panorama's frame: forward, right, up.

    Raises:
        SettingError: An angle is NaN or infinite.

    >>> up_from_pose(0, -90).round(6).tolist()
    [0.0, 1.0, 0.0]
    """
    if not (math.isfinite(pitch_deg) and math.isfinite(roll_deg)):
        raise SettingError("pose", found=(pitch_deg, roll_deg), expected="angles in degrees")
    pitch, roll = math.radians(pitch_deg), math.radians(roll_deg)
    level = math.cos(pitch)
    return np.array([math.sin(pitch), -level * math.sin(roll), level * math.cos(roll)])
