"""Straight edges of a panorama: arcs of great circles, found in pinhole views of it."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from tangent_train.geometry import CubeGrid
from tangent_train.rendering.forward import equirect_to_tangent

_MOST_ROWS = 512
_LEAST_SIDE = 128  # of a face: LSD looks for rows of pixels
_SHORTEST_RAD = np.radians(3)
_MOST = 400  # the longest; more only take time
_LEAST_CONTRAST = 16
_BLACK_BLOCK = np.ones((5, 5), np.uint8)
_BLACK_RIM = np.ones((7, 7), np.uint8)


class LineSegments(NamedTuple):
    """Straight edges as arcs of great circles, the longest first.

    A straight edge of the scene and the centre of the camera span a plane. The vanishing points of
    the edge, and all that is parallel to it, lie in that plane.

    Attributes:
        normals_xyz: ``(n, 3)`` unit normals of the planes.
        middles_xyz: ``(n, 3)`` unit directions of the middles of the arcs.
        lengths_rad: ``(n,)`` lengths of the arcs.
    """

    normals_xyz: NDArray[np.float64]
    middles_xyz: NDArray[np.float64]
    lengths_rad: NDArray[np.float64]


def find_line_segments(rgb: NDArray[np.uint8]) -> LineSegments:
    """Find straight edges on all sides of a panorama.

    The line segment detector LSD (von Gioi et al., PAMI 2010), which bounds false detections in
    noise, works on the six faces of a cube. Edges of black areas are left out: where there is no
    picture, they are those of a cut.

    Args:
        rgb: ``(H, W, 3)``; panoramas of more than 512 rows are shrunk first.

    Returns:
        The 400 longest of the segments from 3°.
    """
    height, width = rgb.shape[:2]
    if height > _MOST_ROWS:
        size = (max(1, round(width * _MOST_ROWS / height)), _MOST_ROWS)
        rgb = cv2.resize(rgb, size, interpolation=cv2.INTER_AREA)
    # In the middle of a face as many pixels per degree as the panorama has at its equator.
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
    """Full contrast for dark rooms: LSD asks for steps of some grey levels."""
    counts = np.bincount(gray[black == 0], minlength=256).cumsum()
    low, high = np.searchsorted(counts, np.array([0.01, 0.99]) * counts[-1])
    steps = (np.arange(256) - low) * (255 / max(high - low, _LEAST_CONTRAST))
    table: NDArray[np.uint8] = np.clip(steps, 0, 255).astype(np.uint8)
    return table[gray]


def _seen_segments(
    detector: cv2.LineSegmentDetector, face: NDArray[np.uint8], unseen: NDArray[np.uint8]
) -> NDArray[np.float64]:
    """``(n, 2, 2)`` ends (x, y) of the segments of a face that are not the rim of black areas."""
    found = detector.detect(face)[0]
    ends = np.zeros((0, 2, 2)) if found is None else found.reshape(-1, 2, 2).astype(np.float64)
    if len(ends) and unseen.any():
        # Single black pixels are dark things, not missing parts.
        areas = cv2.morphologyEx(unseen, cv2.MORPH_OPEN, _BLACK_BLOCK)
        x, y = np.rint(ends.mean(axis=1)).astype(np.intp).clip(0, len(face) - 1).T
        ends = ends[cv2.dilate(areas, _BLACK_RIM)[y, x] == 0]
    return ends


def _arcs(ends_xyz: NDArray[np.float64]) -> LineSegments:
    """Arcs of ``(n, 2, 3)`` directions of their ends."""
    ends = ends_xyz / np.linalg.norm(ends_xyz, axis=-1, keepdims=True)
    normals = np.cross(ends[:, 0], ends[:, 1])
    sines = np.linalg.norm(normals, axis=-1)
    lengths = np.arctan2(sines, np.einsum("ni,ni->n", ends[:, 0], ends[:, 1]))
    order = np.argsort(-lengths, kind="stable")[:_MOST]
    order = order[lengths[order] >= _SHORTEST_RAD]
    middles = ends[order].sum(axis=1)
    middles /= np.linalg.norm(middles, axis=-1, keepdims=True)
    return LineSegments(normals[order] / sines[order, None], middles, lengths[order])
