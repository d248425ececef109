"""One face under Loop subdivision, against whole meshes, trimesh and closed forms."""

from __future__ import annotations

import math

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from tangent_train.errors import SettingError
from tangent_train.geometry import icosphere, loop_lattice, vertex_resolution
from tangent_train.geometry.loop_lattice import MAX_LATTICE_LEVEL, LoopLattice


def mesh_area(vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> float:
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)


@pytest.mark.parametrize("level", range(6))
def test_it_is_the_whole_mesh(level: int) -> None:
    vertices, faces = icosphere(level)
    radius = np.linalg.norm(vertices, axis=1)
    lattice = LoopLattice.at_level(level)
    assert (lattice.num_vertices, lattice.num_faces) == (len(vertices), len(faces))
    assert lattice.area() == pytest.approx(mesh_area(vertices, faces), rel=1e-13)
    unit = vertices / radius[:, None]
    assert lattice.area(on_sphere=True) == pytest.approx(mesh_area(unit, faces), rel=1e-13)
    expected = (radius.min(), radius.mean(), radius.max())
    np.testing.assert_allclose(lattice.radii(), expected, rtol=1e-13)
    assert lattice.vertex_resolution() == pytest.approx(vertex_resolution(level), rel=1e-12)


def test_every_vertex_is_one_of_the_mesh() -> None:
    lattice = LoopLattice.at_level(3)
    i, j = np.indices(lattice.points.shape[:2])
    points = lattice.points[i + j <= 8]
    distance = np.linalg.norm(points[:, None] - icosphere(3).vertices, axis=-1)
    assert len(points) == 45
    assert distance.min(axis=1).max() < 1e-14
    assert len(set(distance.argmin(axis=1).tolist())) == 45
    assert not lattice.points[i + j > 8].any()


def test_trimesh_subdivides_the_same() -> None:
    vertices, faces = icosphere(0)
    loop = trimesh.remesh.subdivide_loop(vertices, faces, iterations=4)
    assert LoopLattice.at_level(4).area() == pytest.approx(mesh_area(*loop), rel=1e-12)


def test_level_0_is_the_icosahedron() -> None:
    edge = 1 / math.sin(math.radians(72))
    assert LoopLattice.at_level(0).area() == pytest.approx(5 * math.sqrt(3) * edge**2, rel=1e-14)


def test_corners_go_where_loops_limit_rule_puts_them() -> None:
    """A vertex of n neighbours ends at (1 − nχ) v + χ Σ w with χ = 1/(n + 3/(8β)) (Loop 1987)."""
    beta = (5 / 8 - (3 / 8 + math.cos(math.radians(72)) / 4) ** 2) / 5
    chi = 1 / (5 + 3 / (8 * beta))
    # The five neighbours of a pole stand at the height 1/√5.
    limit = (1 - 5 * chi) + chi * 5 / math.sqrt(5)
    corners = [LoopLattice.at_level(level).points[0, 0] for level in (8, 9)]
    before, after = np.linalg.norm(corners, axis=1)
    assert after == pytest.approx(limit, abs=2e-6)
    assert abs(after - limit) < 0.3 * abs(before - limit)


def test_vertices_on_the_sphere_make_up_its_area() -> None:
    """The error is a quadratic series in the edges: Richardson's step takes its first term away."""
    coarse, fine = (LoopLattice.at_level(k).area(on_sphere=True) / (4 * math.pi) for k in (6, 7))
    assert (1 - coarse) / (1 - fine) == pytest.approx(4, abs=1e-3)
    assert (4 * fine - coarse) / 3 == pytest.approx(1, abs=1e-8)


def test_level_10_is_within_reach() -> None:
    lattice = LoopLattice.at_level(10)
    # As the paper's figure "icosahedral levels" has it, but for its 20,971,510 faces.
    assert (lattice.num_vertices, lattice.num_faces) == (10_485_762, 20_971_520)
    assert lattice.area(on_sphere=True) / (4 * math.pi) == pytest.approx(1, abs=3e-7)
    halves = lattice.vertex_resolution() / vertex_resolution(6)
    assert halves == pytest.approx(1 / 16, rel=1e-3)


@pytest.mark.parametrize("level", [-1, MAX_LATTICE_LEVEL + 1])
def test_levels_out_of_range_are_refused(level: int) -> None:
    with pytest.raises(SettingError, match=f"found {level}; expected 0 to {MAX_LATTICE_LEVEL}"):
        LoopLattice.at_level(level)


def test_the_greatest_level_is_allowed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(loop_lattice, "MAX_LATTICE_LEVEL", 2)  # that of 12 takes 1.6 GB
    assert len(LoopLattice.at_level(2).points) == 5
    with pytest.raises(SettingError, match="found 3; expected 0 to 2"):
        LoopLattice.at_level(3)
