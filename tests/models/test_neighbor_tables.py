"""Tables of rings, faces and gnomonic taps on the icosphere."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from models.mapped import Table
from models.tables import face_neighbors, gnomonic_points, hexagonal_rings, mapped_samples
from tangent_train.geometry import icosphere, vertex_resolution
from tangent_train.geometry.icosphere import icosphere_directions
from tangent_train.geometry.sphere import gnomonic_points_xyz, tangent_axes

_TABLES = [hexagonal_rings, face_neighbors, gnomonic_points]
_POLES = [0, 11]


def _values(table: Table, signal: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return ``(V_out, K, ...)`` values."""
    return np.asarray(table.matrix @ signal).reshape(-1, table.taps, *signal.shape[1:])


@pytest.mark.parametrize("build", _TABLES)
@pytest.mark.parametrize("level", [0, 3])
def test_rows_are_weighted_means(build: Callable[[int], Table], level: int) -> None:
    table = build(level)
    assert table.outputs == table.inputs
    assert table.matrix.data.min() >= 0
    np.testing.assert_allclose(_values(table, np.ones(table.inputs)), 1, atol=1e-12)


def test_rings_mix_two_hexagonal_filters() -> None:
    """Each vertex by the paper's formula; the ring is found by walking around the vertex."""
    vertices, faces = icosphere(2)
    following = {
        (int(face[i]), int(face[(i + 1) % 3])): int(face[(i + 2) % 3])
        for face in faces
        for i in range(3)
    }
    signal, weight = (np.random.default_rng(i).normal(size=n) for i, n in ((0, 162), (1, 7)))
    got = _values(hexagonal_rings(2), signal) @ weight
    for vertex in range(12, len(vertices)):  # all but the corners of the icosahedron
        ring = [next(b for a, b in following if a == vertex)]
        while len(ring) < 6:
            ring.append(following[vertex, ring[-1]])
        assert following[vertex, ring[-1]] == ring[0]
        up = vertices[vertex] / np.linalg.norm(vertices[vertex])
        # Counterclockwise as seen from outside, in a left-handed frame.
        if np.cross(vertices[ring[0]], vertices[ring[1]]) @ up > 0:
            ring = ring[::-1]
        plane = np.stack([np.cross([0, 0, 1], up), np.cross(up, np.cross([0, 0, 1], up))])
        east, north = plane @ vertices[ring].T
        angle = np.arccos(north / np.hypot(east, north))  # to the north
        west_of_north, east_of_north = angle.argsort()[:2][east[angle.argsort()[:2]].argsort()]
        alpha = angle[east_of_north] / (angle[west_of_north] + angle[east_of_north])
        first = np.roll(ring, -west_of_north)
        mixed = alpha * signal[first] + (1 - alpha) * signal[np.roll(first, -1)]
        assert got[vertex] == pytest.approx(weight[0] * signal[vertex] + weight[1:] @ mixed)


def test_rings_lie_at_fixed_angles_to_the_north() -> None:
    points = icosphere_directions(4)
    taps = _values(hexagonal_rings(4), points)
    np.testing.assert_allclose(taps[:, 0], points)
    east, north = np.einsum("vij,vkj->ivk", tangent_axes(points)[:, :2], taps[:, 1:])
    error = np.degrees(np.arctan2(east, north)) - 60 * np.arange(6)
    error = np.abs((error + 180) % 360 - 180)
    np.testing.assert_array_less(error[1:11].max(), 1.9)  # regular rings of five neighbors
    np.testing.assert_array_less(error[12:, 0].max(), 2.7)
    np.testing.assert_array_less(error[12:].max(), 12.2)  # hexagons of the mesh are not regular
    np.testing.assert_allclose(north[_POLES], 0, atol=1e-12)  # means of their rings
    np.testing.assert_allclose(np.ptp(taps[_POLES, 1:], axis=1), 0, atol=1e-12)


@pytest.mark.parametrize("level", [0, 1, 3])
def test_ten_different_faces_share_an_edge_or_a_vertex(level: int) -> None:
    faces = icosphere(level).faces
    table = face_neighbors(level).matrix.indices.reshape(-1, 10)
    np.testing.assert_array_equal(table[:, 0], np.arange(len(faces)))
    assert (np.diff(np.sort(table, axis=1), axis=1) > 0).all()
    shared = (faces[table][:, :, :, None] == faces[:, None, None, :]).sum(axis=(2, 3))
    np.testing.assert_array_equal(shared, [[3, 2, 2, 2, *[1] * 6]] * len(faces))


def test_order_of_faces_is_that_of_the_unfolded_icosahedron() -> None:
    centers = icosphere_directions(4, "faces")
    offsets = _values(face_neighbors(4), centers) - centers[:, None]
    middle = np.arange(len(centers)).reshape(20, 4, 4, 4, 4)[:, 3, 3, 3, 3]  # face in the middle
    # The middle of a base face points as the face does at even levels: five up, five down, twice.
    is_upward = offsets[middle, 1, 2] < 0  # the first neighbor is in the south
    np.testing.assert_array_equal(is_upward, np.arange(20) // 5 % 2 == 0)
    beside = face_neighbors(4).matrix.indices.reshape(-1, 10)[middle, 1]
    cosine = (offsets[middle] * offsets[beside]).sum(axis=-1)[:, 1:]
    cosine /= np.linalg.norm(offsets[middle, 1:], axis=-1)
    cosine /= np.linalg.norm(offsets[beside, 1:], axis=-1)
    np.testing.assert_array_less(cosine, -0.95)  # turned by 180° beside it


def _some_directions() -> NDArray[np.float64]:
    directions = np.random.default_rng(0).normal(size=(5, 2, 3))
    return np.asarray(directions / np.linalg.norm(directions, axis=-1, keepdims=True))


@pytest.mark.parametrize(
    ("table", "expected"),
    [
        (mapped_samples(2, _some_directions()), _some_directions()),
        (
            gnomonic_points(2),
            gnomonic_points_xyz(icosphere_directions(2), 3, np.tan(vertex_resolution(2))),
        ),
    ],
    ids=["mapped_samples", "gnomonic_points"],
)
def test_taps_interpolate_at_their_directions(table: Table, expected: NDArray[np.float64]) -> None:
    assert (table.outputs, table.taps, table.inputs) == (*expected.shape[:2], 162)
    taps = _values(table, icosphere_directions(2))
    taps /= np.linalg.norm(taps, axis=-1, keepdims=True)
    np.testing.assert_allclose(taps, expected, atol=1e-12)
