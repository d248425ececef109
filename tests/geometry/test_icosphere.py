"""The icosahedron, its Loop subdivisions and their cells, against closed forms and trimesh."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from tangent_train.geometry import icosphere, vertex_resolution
from tangent_train.geometry.icosphere import (
    IcosphereElements,
    faces_of_vertices,
    icosphere_count,
    icosphere_directions,
    locate,
    nearest_vertices,
    sampling_points,
)
from tests.geometry.directions import random_directions, unit
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


@pytest.mark.parametrize("level", [0, 1, 2, 5])
def test_directions_are_between_the_vertices_of_their_face(level: int) -> None:
    vertices, faces = icosphere_directions(level), icosphere(level).faces
    for directions in (random_directions(3000), vertices[:200]):
        found, weights = locate(level, directions)
        assert (weights >= 0).all()
        np.testing.assert_allclose(weights.sum(axis=1), 1, rtol=1e-14)
        inside = np.einsum("pi,pic->pc", weights, vertices[faces[found]])
        np.testing.assert_allclose(unit(inside), directions, atol=1e-13)
    # Both poles and the 12 corners are among the vertices.
    nearest = np.take_along_axis(faces[found], weights.argmax(axis=1)[:, None], axis=1)[:, 0]
    assert nearest.tolist() == list(range(len(nearest)))
    np.testing.assert_allclose(weights.max(axis=1), 1, atol=1e-13)
    middles = unit(vertices[faces[:20]] + vertices[faces[:20, [1, 2, 0]]]).reshape(-1, 3)
    on_edges = np.sort(locate(level, middles)[1], axis=1)
    np.testing.assert_allclose(on_edges, [[0, 0.5, 0.5]] * len(middles), atol=1e-13)


def test_nearest_vertices_and_faces_around_vertices() -> None:
    vertices, faces = icosphere_directions(2), icosphere(2).faces
    directions = random_directions(500)
    assert (nearest_vertices(2, directions) == (directions @ vertices.T).argmax(axis=1)).all()
    for vertex, around in enumerate(faces_of_vertices(2)):
        expected = np.flatnonzero((faces == vertex).any(axis=1))
        assert sorted(set(around.tolist()) - {-1}) == expected.tolist()
        assert (around < 0).sum() == (vertex < 12)


@pytest.mark.parametrize("elements", ["vertices", "faces"])
def test_directions_are_nested(elements: IcosphereElements) -> None:
    coarse, fine = icosphere_directions(2, elements), icosphere_directions(3, elements)
    assert len(fine) == icosphere_count(3, elements)
    np.testing.assert_allclose(np.linalg.norm(fine, axis=1), 1, rtol=1e-15)
    same = fine[: len(coarse)] if elements == "vertices" else fine[3::4]
    # Loop subdivision moves vertices a little; the step to the next vertex is 0.15 or more.
    assert np.abs(same - coarse).max() < 0.02


def _solid_angles(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return steradians of triangles with unit vectors ``(n, 3, 3)`` at their corners.

    Van Oosterom and Strackee, IEEE Trans. Biomed. Eng. 1983, equation 8.
    """
    a, b, c = np.moveaxis(corners, 1, 0)
    dots = 1 + (a * b).sum(1) + (b * c).sum(1) + (c * a).sum(1)
    angles: NDArray[np.float64] = 2 * np.arctan2(np.abs(np.linalg.det(corners)), dots)
    return angles


def test_points_of_a_cell_have_the_weight_of_their_solid_angle() -> None:
    """Of the triangles between a corner, the middle of an edge and the center of a face."""
    corners = icosphere_directions(1)[icosphere(1).faces]
    parts = np.empty((len(corners), 3, 2, 3, 3))
    for corner, side in np.ndindex(3, 2):
        middle = corners[:, [corner, (corner + 1 + side) % 3]].mean(axis=1)
        parts[:, corner, side] = np.stack([corners[:, corner], middle, corners.mean(axis=1)], 1)
    parts /= np.linalg.norm(parts, axis=-1, keepdims=True)
    angles = _solid_angles(parts.reshape(-1, 3, 3))
    assert angles.sum() == pytest.approx(4 * np.pi)
    _, source, weight = sampling_points(1, "vertices")
    expected = angles[source] * (weight > 0)
    np.testing.assert_allclose(weight, expected / expected.sum(axis=0), atol=2e-4)


@pytest.mark.parametrize("elements", ["vertices", "faces"])
def test_means_over_cells_are_integrals(elements: IcosphereElements) -> None:
    points, source, weight = sampling_points(1, elements)
    np.testing.assert_allclose(weight.sum(axis=0), 1, rtol=1e-6)
    fine, corners = icosphere_directions(6, "faces"), icosphere_directions(6)[icosphere(6).faces]
    solid_angles = _solid_angles(corners)
    found, shares = locate(1, fine)
    owner = found
    if elements == "vertices":
        owner = np.take_along_axis(icosphere(1).faces[found], shares.argmax(1)[:, None], 1)[:, 0]

    def function(at: NDArray[np.floating]) -> NDArray[np.floating]:
        return np.sin(3 * at) + at[:, [1, 2, 0]] * at

    total = np.bincount(owner, solid_angles)
    expected = np.stack(
        [np.bincount(owner, solid_angles * values) / total for values in function(fine).T]
    )
    error = (function(points)[source] * weight[..., None]).sum(axis=0).T - expected
    error_of_centers = function(icosphere_directions(1, elements)).T - expected
    # Level 1 is coarse: a rule with one point per triangle has a sixth of the error of one point.
    assert (error**2).mean() < 0.2**2 * (error_of_centers**2).mean()
