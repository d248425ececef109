"""Segments of known edges, and frames of segments of known directions."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from tangent_train.geometry import equirect_directions, random_rotation
from tangent_train.rendering.upright.line_segments import LineSegments, find_line_segments
from tangent_train.rendering.upright.manhattan import find_manhattan_frames
from tests.geometry.directions import unit


@pytest.mark.parametrize("height", [128, 700])
@pytest.mark.parametrize("seed", range(2))
def test_an_edge_all_around_is_found_on_its_great_circle(height: int, seed: int) -> None:
    normal = unit(np.random.default_rng(seed).normal(size=3))
    side = np.clip(equirect_directions((height, 2 * height)) @ normal * height / 3, -1, 1)
    gray = (130 + 60 * side).astype(np.uint8)
    segments = find_line_segments(np.repeat(gray[..., None], 3, axis=-1))
    sines = np.linalg.norm(np.cross(segments.normals_xyz, normal), axis=1)
    assert np.median(sines) < math.radians(0.3)
    # No end is two pixels off; where a corner of a face is cut, the piece is short.
    pixel = math.radians(90) / max(128, height * 2 / math.pi)
    assert (sines * segments.lengths_rad / 2).max() < 2 * pixel
    assert 0.9 < segments.lengths_rad.sum() / (2 * math.pi) < 1.05
    assert np.abs(segments.middles_xyz @ normal).max() < pixel
    np.testing.assert_allclose(np.linalg.norm(segments.middles_xyz, axis=1), 1)
    assert np.all(np.diff(segments.lengths_rad) <= 0)


def _segments(
    axes: NDArray[np.float64], counts: tuple[int, int, int], others: int, seed: int = 0
) -> LineSegments:
    """Exact segments along three axes, and some of random directions."""
    rng = np.random.default_rng(seed)
    along = np.concatenate([np.repeat(axes.T, counts, axis=0), unit(rng.normal(size=(others, 3)))])
    normals = unit(np.cross(along, rng.normal(size=along.shape)))
    middles = unit(np.cross(normals, rng.normal(size=along.shape)))
    return LineSegments(normals, middles, rng.uniform(0.1, 0.6, len(along)))


@pytest.mark.parametrize("counts", [(20, 20, 20), (40, 15, 0), (5, 30, 5)])
@pytest.mark.parametrize("seed", range(2))
def test_frames_of_exact_segments(counts: tuple[int, int, int], seed: int) -> None:
    axes = random_rotation(np.random.default_rng(seed))
    segments = _segments(axes, counts, others=30, seed=seed)
    frame = find_manhattan_frames(segments)[0]
    agreement = np.abs(frame.axes_xyz.T @ axes)
    np.testing.assert_allclose(np.sort(agreement, axis=1), np.tile([0, 0, 1.0], (3, 1)), atol=0.02)
    np.testing.assert_allclose(frame.axes_xyz.T @ frame.axes_xyz, np.eye(3), atol=1e-9)
    order = agreement.argmax(axis=0)
    weights = np.minimum(segments.lengths_rad, 0.5)
    exact = np.add.reduceat(np.append(weights, 0), [0, *np.cumsum(counts)])[:3] * (
        np.array(counts) > 0
    )
    assert np.all(frame.support[order] >= 0.9 * exact / weights.sum())
    assert frame.significance > 3


@pytest.mark.parametrize("count", [4, 40])
def test_random_segments_are_not_significant(count: int) -> None:
    best = [
        find_manhattan_frames(_segments(np.eye(3), (0, 0, 0), count, seed))[0].significance
        for seed in range(10)
    ]
    assert max(best) < 2.2
