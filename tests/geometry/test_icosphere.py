"""The icosahedron and its Loop subdivisions, against closed forms and trimesh."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from tangent_train.errors import SettingError
from tangent_train.geometry import Icosphere, icosphere, vertex_resolution

LEVELS = range(5)


def face_centers(mesh: Icosphere) -> NDArray[np.float64]:
    centers = mesh.vertices[mesh.faces].mean(axis=1)
    return np.asarray(centers / np.linalg.norm(centers, axis=1, keepdims=True))


def directed_edges(faces: NDArray[np.int64]) -> list[tuple[int, int]]:
    return [(a, b) for a, b in faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2).tolist()]


def test_level_0_is_a_regular_icosahedron_on_its_pole() -> None:
    vertices, faces = icosphere(0)
    edges = vertices[faces] - vertices[np.roll(faces, 1, axis=1)]
    # A unit icosahedron has edges of 1/sin(72°).
    np.testing.assert_allclose(np.linalg.norm(edges, axis=-1), 1 / np.sin(np.radians(72)))
    np.testing.assert_allclose(np.linalg.norm(vertices, axis=1), 1)
    np.testing.assert_allclose(np.sort(vertices[:, 2])[[0, -1]], [-1, 1])


def test_level_0_face_centres_lie_on_four_latitudes() -> None:
    latitudes = np.degrees(np.arcsin(face_centers(icosphere(0))[:, 2]))
    expected = np.repeat([-52.6226, -10.8123, 10.8123, 52.6226], 5)
    np.testing.assert_allclose(np.sort(latitudes), expected, atol=5e-5)


@pytest.mark.parametrize("level", LEVELS)
def test_mesh_is_closed_and_of_one_winding(level: int) -> None:
    vertices, faces = icosphere(level)
    assert faces.shape == (20 * 4**level, 3)
    assert vertices.shape == (10 * 4**level + 2, 3)
    assert (vertices.dtype.name, faces.dtype.name) == ("float64", "int64")
    edges = directed_edges(faces)
    # Every directed edge once, its reverse once: closed, one winding; V − E + F = 2: a sphere.
    assert len(set(edges)) == len(edges)
    assert set(edges) == {(b, a) for a, b in edges}
    assert len(vertices) - len(edges) // 2 + len(faces) == 2
    triple = np.linalg.det(vertices[faces])
    assert (np.sign(triple) == np.sign(triple[0])).all()
    assert triple[0] != 0


@pytest.mark.parametrize("level", [1, 2, 3, 4])
def test_subdivision_is_trimeshs_loop_subdivision(level: int) -> None:
    vertices, faces = trimesh.remesh.subdivide_loop(*icosphere(0), iterations=level)
    theirs = face_centers(Icosphere(np.asarray(vertices), np.asarray(faces)))
    ours = face_centers(icosphere(level))
    for points, others in ((icosphere(level).vertices, vertices), (ours, theirs)):
        distance, match = cKDTree(others).query(points)
        assert distance.max() < 1e-12
        assert len(set(match.tolist())) == len(others)


def test_vertices_are_not_normalised_between_levels() -> None:
    # The limit surface of Loop subdivision shrinks; normalising would keep radius 1.
    radius = np.linalg.norm(icosphere(1).vertices, axis=1)
    assert radius.max() < 0.9


@pytest.mark.parametrize(
    ("base_level", "resolution"),
    [(-1, 2.2142974), (0, 1.1071487), (1, 0.5891668), (2, 0.2990932), (3, 0.1501557),
     (4, 0.0751607), (5, 0.0375915)],
)  # fmt: skip
def test_vertex_resolution(base_level: int, resolution: float) -> None:
    assert vertex_resolution(base_level) == pytest.approx(resolution, abs=5.1e-8)


def test_vertex_resolution_is_the_papers_double_mean() -> None:
    assert vertex_resolution(0) == pytest.approx(np.arctan(2), rel=1e-14)  # closed form
    vertices, faces = icosphere(2)
    units = vertices / np.linalg.norm(vertices, axis=1, keepdims=True)
    neighbors: list[set[int]] = [set() for _ in vertices]
    for a, b in directed_edges(faces):
        neighbors[a].add(b)
    means = [
        np.mean([np.arccos(units[v] @ units[w]) for w in around])
        for v, around in enumerate(neighbors)
    ]
    assert vertex_resolution(2) == pytest.approx(np.mean(means), rel=1e-12)


@pytest.mark.parametrize("level", [-1, 9])
def test_impossible_levels_are_refused(level: int) -> None:
    with pytest.raises(SettingError, match=f"icosphere level: found {level}; expected 0 to 8"):
        icosphere(level)
