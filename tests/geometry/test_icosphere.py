"""The icosahedron and its Loop subdivisions, against closed forms and trimesh."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from tangent_train.errors import SettingError
from tangent_train.geometry import Icosphere, icosphere, vertex_resolution
from tests.rendering import reference


def face_centers(mesh: Icosphere) -> NDArray[np.float64]:
    centers = mesh.vertices[mesh.faces].mean(axis=1)
    return np.asarray(centers / np.linalg.norm(centers, axis=1, keepdims=True))


def test_level_0_is_a_regular_icosahedron_on_its_pole() -> None:
    vertices, faces = icosphere(0)
    edges = vertices[faces] - vertices[np.roll(faces, 1, axis=1)]
    # A unit icosahedron has edges of 1/sin(72°).
    np.testing.assert_allclose(np.linalg.norm(edges, axis=-1), 1 / np.sin(np.radians(72)))
    np.testing.assert_allclose(np.linalg.norm(vertices, axis=1), 1)
    np.testing.assert_allclose(np.sort(vertices[:, 2])[[0, -1]], [-1, 1])


@pytest.mark.parametrize("level", [1, 2, 3, 4])
def test_subdivision_is_trimeshs_loop_subdivision(level: int) -> None:
    vertices, faces = trimesh.remesh.subdivide_loop(*icosphere(0), iterations=level)
    theirs = face_centers(Icosphere(np.asarray(vertices), np.asarray(faces)))
    ours = face_centers(icosphere(level))
    for points, others in ((icosphere(level).vertices, vertices), (ours, theirs)):
        distance, match = cKDTree(others).query(points)
        assert distance.max() < 1e-12
        assert len(set(match.tolist())) == len(others) == len(points)
    triple = np.linalg.det(icosphere(level).vertices[icosphere(level).faces])
    assert (triple * triple[0] > 0).all(), "all faces have one winding"


@pytest.mark.parametrize("level", [-1, 0, 1, 2, 3])
def test_vertex_resolution_is_the_papers_double_mean(level: int) -> None:
    assert vertex_resolution(level) == pytest.approx(reference.vertex_resolution(level), rel=1e-12)


@pytest.mark.parametrize("level", [-1, 9])
def test_impossible_levels_are_refused(level: int) -> None:
    with pytest.raises(SettingError, match=f"icosphere level: found {level}; expected 0 to 8"):
        icosphere(level)
