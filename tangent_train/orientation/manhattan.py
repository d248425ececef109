"""Manhattan frames: three directions at right angles that the straight edges of a scene follow.

Straight edges appear in a panorama as arcs of great circles. They are detected in pinhole views.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from tangent_train.geometry import CubeGrid, icosphere, rotation_about
from tangent_train.geometry.sphere import Floats
from tangent_train.rendering.forward import equirect_to_tangent

MOST_ROWS = 512
"""Larger panoramas are resized to this number of rows."""

_LEAST_SIDE = 128  # of a face: LSD needs lines of several pixels
_SHORTEST_RAD = np.radians(3)
_MOST = 400  # the longest segments; more take time without better results
_LEAST_CONTRAST = 16
_BLACK_BLOCK = np.ones((5, 5), np.uint8)
_BLACK_RIM = np.ones((7, 7), np.uint8)

_SEARCH_TOLERANCE = np.sin(np.radians(4))
_TOLERANCE = np.sin(np.radians(2))
_REFINEMENTS = np.sin(np.radians([4, 3, 2, 1.5, 1.2, 1.2, 1.2]))
_CHANCE = 2 * _TOLERANCE  # ∫ (1 − q²/τ²) dq = 2τ/3 of every axis, for |cos| q uniform on [0, 1]
_LONGEST_RAD = 0.5  # longer segments get the same weight: a single beam is not a room
_FIRST_AXES = 24
_APART = np.cos(np.radians(6))
_FRAMES = 8


class LineSegments(NamedTuple):
    """Straight edges as arcs of great circles, the longest first.

    A straight edge of the scene and the center of the camera span a plane. The plane contains the
    vanishing points of the edge, which are those of all parallel edges.

    Attributes:
        normals_xyz: ``(n, 3)`` unit normals of the planes.
        middles_xyz: ``(n, 3)`` unit directions of the middles of the arcs.
        lengths_rad: ``(n,)`` lengths of the arcs.
    """

    normals_xyz: Floats
    middles_xyz: Floats
    lengths_rad: Floats


class ManhattanFrame(NamedTuple):
    """Three directions at right angles.

    Attributes:
        axes_xyz: ``(3, 3)`` unit directions as columns, of either sign and in any order.
        significance: Number of standard deviations by which more segments follow the frame than
            random segments would follow a given frame. For random segments, the best of all frames
            reached about 1.5, and at most 2.
    """

    axes_xyz: Floats
    significance: float


def find_line_segments(rgb: NDArray[np.uint8]) -> LineSegments:
    """Find straight edges on all sides of a panorama.

    The line segment detector LSD (von Gioi et al., PAMI 2010), which limits false detections in
    noise, is applied to the six faces of a cube. Edges of black areas are left out, because they
    are borders of missing parts.

    Args:
        rgb: ``(H, W, 3)`` panorama; with more than 512 rows it is resized first.

    Returns:
        The longest segments of at least 3°, up to 400.
    """
    height, width = rgb.shape[:2]
    if height > MOST_ROWS:
        size = (max(1, round(width * MOST_ROWS / height)), MOST_ROWS)
        rgb = cv2.resize(rgb, size, interpolation=cv2.INTER_AREA)
    # The middle of a face has as many pixels per degree as the panorama's equator.
    grid = CubeGrid(max(_LEAST_SIDE, round(rgb.shape[0] * 2 / np.pi)))
    black = (rgb.max(axis=-1) == 0).astype(np.uint8)
    gray = _stretched(cv2.cvtColor(np.ascontiguousarray(rgb), cv2.COLOR_RGB2GRAY), black)
    faces = equirect_to_tangent(gray, grid)
    unseen = equirect_to_tangent(black, grid, interpolation="nearest")
    detector = cv2.createLineSegmentDetector()
    pixels = [_seen_segments(detector, *pair) for pair in zip(faces, unseen, strict=True)]
    rays = [
        np.concatenate([(xy - (grid.dim - 1) / 2) * grid.pitch, np.ones((*xy.shape[:2], 1))], -1)
        @ axes.T
        for xy, axes in zip(pixels, grid.world_from_camera, strict=True)
    ]
    return _arcs(np.concatenate(rays))


def _stretched(gray: NDArray[np.uint8], black: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Stretch the contrast of dark rooms, because LSD needs steps of several gray levels."""
    counts = np.bincount(gray[black == 0], minlength=256).cumsum()
    low, high = np.searchsorted(counts, np.array([0.01, 0.99]) * counts[-1])
    steps = (np.arange(256) - low) * (255 / max(high - low, _LEAST_CONTRAST))
    return np.clip(steps, 0, 255).astype(np.uint8)[gray]


def _seen_segments(
    detector: cv2.LineSegmentDetector, face: NDArray[np.uint8], unseen: NDArray[np.uint8]
) -> Floats:
    """Return ``(n, 2, 2)`` ends (x, y) of segments of a face, without rims of black areas."""
    found = detector.detect(face)[0]
    ends = np.zeros((0, 2, 2)) if found is None else found.reshape(-1, 2, 2).astype(np.float64)
    if len(ends) and unseen.any():
        # Single black pixels are dark objects, not missing parts.
        areas = cv2.morphologyEx(unseen, cv2.MORPH_OPEN, _BLACK_BLOCK)
        x, y = np.rint(ends.mean(axis=1)).astype(np.intp).clip(0, len(face) - 1).T
        ends = ends[cv2.dilate(areas, _BLACK_RIM)[y, x] == 0]
    return ends


def _arcs(ends_xyz: Floats) -> LineSegments:
    """Return the longest arcs, given the directions of their ends, ``(n, 2, 3)``."""
    ends = ends_xyz / np.linalg.norm(ends_xyz, axis=-1, keepdims=True)
    normals = np.cross(ends[:, 0], ends[:, 1])
    sines = np.linalg.norm(normals, axis=-1)
    lengths = np.arctan2(sines, np.einsum("ni,ni->n", ends[:, 0], ends[:, 1]))
    order = np.argsort(-lengths, kind="stable")[:_MOST]
    order = order[lengths[order] >= _SHORTEST_RAD]
    middles = ends[order].sum(axis=1)
    middles /= np.linalg.norm(middles, axis=-1, keepdims=True)
    return LineSegments(normals[order] / sines[order, None], middles, lengths[order])


def segment_weights(segments: LineSegments) -> Floats:
    """Return ``(n,)`` weights: lengths in radians, at most half a radian."""
    return np.minimum(segments.lengths_rad, _LONGEST_RAD)


def followed_axes(segments: LineSegments, axes_xyz: Floats) -> tuple[NDArray[np.intp], Floats]:
    """Assign each segment to an axis, with a measure of agreement.

    Args:
        segments: n segments.
        axes_xyz: ``(3, 3)`` unit directions as columns.

    Returns:
        ``(n,)`` columns of the nearest axes; and ``(n,)`` agreement from 1 (the plane of the
        segment contains the axis) to 0 (the axis is 2° or more off: the segment follows no axis).
    """
    cosines = np.abs(segments.normals_xyz @ axes_xyz)
    return cosines.argmin(axis=1), _agreement(cosines.min(axis=1), _TOLERANCE)


def find_manhattan_frames(segments: LineSegments) -> list[ManhattanFrame]:
    """Find the frames that most segments follow, the best first.

    The first axis is searched on a grid of all directions, the second in steps of one degree around
    each of the best; reweighted least squares refines the frame. The result is deterministic.

    Args:
        segments: Line segments of a panorama.

    Returns:
        Up to 8 frames that differ by more than 6°; empty for fewer than four segments.
    """
    if len(segments.lengths_rad) < 4:
        return []
    weights = segment_weights(segments)
    normals = segments.normals_xyz
    found = [_around(axis, normals, weights) for axis in _first_axes(normals, weights)]
    found.sort(key=lambda pair: -pair[0])
    frames: list[ManhattanFrame] = []
    for _, axes in found:
        refined = _refined(axes, normals, weights)
        if not any(_same(refined, frame.axes_xyz) for frame in frames):
            frames.append(_assessed(refined, segments, weights))
        if len(frames) == _FRAMES:
            break
    return sorted(frames, key=lambda frame: -frame.significance)


def _agreement(cosines: NDArray[Any], tolerance: float) -> NDArray[Any]:
    return np.maximum(0, 1 - (cosines / tolerance) ** 2)


@lru_cache(maxsize=1)
def _hemisphere() -> NDArray[np.float32]:
    """Return ``(1286, 3)`` directions about 4° apart: half of a sphere, and its rim."""
    vertices = icosphere(4).vertices
    directions = vertices / np.linalg.norm(vertices, axis=1, keepdims=True)
    return directions[directions[:, 2] > -1e-9].astype(np.float32)


def _first_axes(normals: Floats, weights: Floats) -> list[Floats]:
    """Return directions that many segments follow, the best first, at least 6° apart."""
    directions = _hemisphere()
    agreement = _agreement(np.abs(directions @ normals.T.astype(np.float32)), _SEARCH_TOLERANCE)
    scores = agreement @ weights.astype(np.float32)
    axes: list[Floats] = []
    while len(axes) < _FIRST_AXES and (best := int(scores.argmax())) >= 0 and scores[best] > 0:
        axis = directions[best].astype(np.float64)
        axes.append(axis / np.linalg.norm(axis))
        scores[np.abs(directions @ directions[best]) > _APART] = 0
    return axes


def _around(axis: Floats, normals: Floats, weights: Floats) -> tuple[float, Floats]:
    """Return the score of the best frame with a given axis, and the frame, in steps of a degree."""
    second = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    second /= np.linalg.norm(second)
    third = np.cross(axis, second)
    angles = np.radians(np.arange(180.0))
    circle = np.cos(angles)[:, None] * second + np.sin(angles)[:, None] * third
    agreement = _agreement(np.abs((circle @ normals.T).astype(np.float32)), _SEARCH_TOLERANCE)
    along = agreement @ weights.astype(np.float32)
    pairs = along[:90] + along[90:]
    best = int(pairs.argmax())
    score = pairs[best] + _agreement(np.abs(normals @ axis), _SEARCH_TOLERANCE) @ weights
    axes = np.stack([axis, circle[best], np.cross(axis, circle[best])], axis=1)
    return float(score), axes


def _refined(axes: Floats, normals: Floats, weights: Floats) -> Floats:
    """Return a frame rotated to the best agreement with the segments that follow it."""
    for tolerance in _REFINEMENTS:
        cosines = normals @ axes
        nearest = np.abs(cosines).argmin(axis=1)
        residuals = np.take_along_axis(cosines, nearest[:, None], axis=1)[:, 0]
        agreed = weights * _agreement(np.abs(residuals), tolerance)
        # A small rotation δ, in axes of the frame, moves axis e to e + δ×e: n·(δ×e) = δ·(e×n).
        slopes = np.cross(np.eye(3)[nearest], cosines)
        normal_matrix = (slopes * agreed[:, None]).T @ slopes + 1e-9 * np.eye(3)
        step = -np.linalg.solve(normal_matrix, slopes.T @ (agreed * residuals))
        angle = float(np.linalg.norm(step))
        if angle > 1e-12:
            axes = axes @ rotation_about(step, angle)
    return axes


def _same(axes: Floats, others: Floats) -> bool:
    return bool((np.abs(axes.T @ others).max(axis=0) > _APART).all())


def _assessed(axes: Floats, segments: LineSegments, weights: Floats) -> ManhattanFrame:
    _, agreement = followed_axes(segments, axes)
    support = (weights * agreement).sum() / weights.sum()
    number = weights.sum() ** 2 / (weights**2).sum()
    return ManhattanFrame(axes, float((support - _CHANCE) * np.sqrt(number)))
