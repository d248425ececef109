"""The icosahedron and its Loop subdivisions, against closed forms and trimesh."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from tangent_train.geometry import icosphere, vertex_resolution
from tests.rendering import reference


@pytest.mark.parametrize("level", [0, 1, 2, 3, 4])
def test_subdivision_is_trimeshs_loop_subdivision(level: int) -> None:
    mesh, expected = icosphere(level), reference.subdivided_icosahedron(level)
    centers = mesh.vertices[mesh.faces].mean(axis=1), expected.triangles_center
    for points, others in ((mesh.vertices, expected.vertices), centers):
        distance, match = cKDTree(others).query(points)
        assert distance.max() < 1e-12
        assert len(set(match.tolist())) == len(others) == len(points)
    triple = np.linalg.det(mesh.vertices[mesh.faces])
    assert (triple * triple[0] > 0).all(), "all faces have one winding"


@pytest.mark.parametrize("level", [-1, 0, 1, 2, 3])
def test_vertex_resolution_is_the_papers_double_mean(level: int) -> None:
    assert vertex_resolution(level) == pytest.approx(reference.vertex_resolution(level), rel=1e-12)
