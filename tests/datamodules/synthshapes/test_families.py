from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from datamodules.modelnet40.mesh_spheres import clean_mesh, mesh_spheres
from datamodules.synthshapes.families import CLASSES, make_shape
from datamodules.synthshapes.parts import Parts
from tangent_train.geometry import rotation_about

if TYPE_CHECKING:
    from numpy.typing import NDArray

SHAPE = (8, 16)


def _parts() -> Parts:
    return Parts(np.random.default_rng(0))


def _extent(parts: Parts) -> NDArray[np.float64]:
    vertices = parts.mesh().vertices
    return np.array([vertices.min(axis=0), vertices.max(axis=0)]).round(6)


# --- parts -------------------------------------------------------------------------------------


def test_parts_are_where_they_should_be() -> None:
    parts = _parts()
    parts.box((1, 2, 3), (2, 4, 6))
    np.testing.assert_allclose(_extent(parts), [[0, 0, 0], [2, 4, 6]])
    parts = _parts()
    parts.box((0, 0, 0), (2, 4, 6), rotation_about((0, 0, 1), np.pi / 2))
    np.testing.assert_allclose(_extent(parts), [[-2, -1, -3], [2, 1, 3]])
    parts = _parts()
    parts.rod((0, 0, 0), (5, 0, 0), 1)
    np.testing.assert_allclose(_extent(parts), [[0, -1, -1], [5, 1, 1]], atol=0.05)
    parts = _parts()
    parts.rod((0, 0, 2), (0, 0, -3), 1, 0.5)  # straight down: no axis to turn about
    np.testing.assert_allclose(_extent(parts), [[-1, -1, -3], [1, 1, 2]], atol=0.05)
    below = parts.mesh().vertices[parts.mesh().vertices[:, 2] < -2.9]
    np.testing.assert_allclose(np.abs(below).max(axis=0), [0.5, 0.5, 3], atol=0.03)
    parts = _parts()
    parts.leg((1, 1, 4), (1, 1, 0), 0.2, square=True)
    np.testing.assert_allclose(_extent(parts), [[0.9, 0.9, 0], [1.1, 1.1, 4]])
    parts = _parts()
    parts.turned([(0, 0), (2, 0), (1, 5)], (1, 0, 0))
    np.testing.assert_allclose(_extent(parts), [[-1, -2, 0], [3, 2, 5]], atol=0.05)
    parts = _parts()
    parts.ring((0, 0, 1), 2, 0.5, rotation_about((1, 0, 0), np.pi / 2))
    np.testing.assert_allclose(_extent(parts), [[-2.5, -0.5, -1.5], [2.5, 0.5, 3.5]], atol=0.05)
    parts = _parts()
    parts.ellipsoid((0, 0, 0), (1, 2, 3))
    np.testing.assert_allclose(_extent(parts), [[-1, -2, -3], [1, 2, 3]], atol=0.05)
    parts = _parts()
    parts.panel([(0, 0, 0), (3, 0, 0), (3, 2, 0), (0, 2, 0)], 0.2)
    np.testing.assert_allclose(_extent(parts), [[0, 0, -0.1], [3, 2, 0.1]])


def test_pieces_are_one_mesh() -> None:
    parts = _parts()
    parts.box((0, 0, 0), (1, 1, 1))
    parts.box((5, 0, 0), (1, 1, 1))
    vertices, triangles = parts.mesh()
    assert (len(vertices), len(triangles)) == (16, 24)
    assert vertices[triangles[:12], 0].max() < 1
    assert vertices[triangles[12:], 0].min() > 4


# --- classes -----------------------------------------------------------------------------------


def test_ten_classes_in_alphabetical_order() -> None:
    assert len(CLASSES) == 10
    assert list(CLASSES) == sorted(CLASSES)


@pytest.mark.parametrize("label", CLASSES)
def test_individuals_can_be_used_and_differ(label: str) -> None:
    images = []
    for number in range(12):
        mesh = make_shape(0, label, number)
        assert np.isfinite(mesh.vertices).all()
        assert mesh.triangles.min() == 0
        assert mesh.triangles.max() == len(mesh.vertices) - 1
        assert 24 <= len(mesh.triangles) < 5000
        images.append(mesh_spheres(clean_mesh(mesh), SHAPE))
    apart = [np.abs(a - b).mean() for k, a in enumerate(images) for b in images[:k]]
    assert min(apart) > 0.005


def test_the_same_arguments_give_the_same_shape() -> None:
    first, again = make_shape(1, "lamp", 7), make_shape(1, "lamp", 7)
    np.testing.assert_array_equal(first.vertices, again.vertices)
    np.testing.assert_array_equal(first.triangles, again.triangles)
    for other in (make_shape(2, "lamp", 7), make_shape(1, "lamp", 8)):
        assert not np.array_equal(first.vertices[:20], other.vertices[:20])


def test_chairs_have_backs_at_the_rear() -> None:
    """Upright, with a heading near that of their class: the upper half is behind, at −x."""
    behind = 0
    for number in range(40):
        vertices = clean_mesh(make_shape(0, "chair", number)).vertices
        behind += vertices[vertices[:, 2] > vertices[:, 2].max() * 0.7, 0].mean() < 0
    assert behind >= 36


def test_individuals_have_their_own_units_and_origins() -> None:
    sizes = [np.ptp(make_shape(0, "cup", number).vertices) for number in range(20)]
    assert max(sizes) > 20 * min(sizes)
