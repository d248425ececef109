"""OFF files, and spheres against closed forms and a slow reference in float64."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from trimesh import Trimesh, creation

from datamodules.modelnet40.meshes import RADIUS, clean_mesh, mesh_spheres, read_mesh
from datamodules.synthshapes import make_shape
from tangent_train.errors import DataError
from tangent_train.geometry import equirect_directions, random_rotation
from tests.datamodules.rays import hit_distances

SHAPE = (64, 128)
RAYS = equirect_directions(SHAPE)
FACES = [[0, 1, 2], [0, 2, 3]]
POINTS = "0 0 0\n1 0 0\n1 1 0\n0 1 0.5\n"


def _mesh(vertices: Any, faces: Any) -> Trimesh:
    return Trimesh(np.array(vertices, np.float64), np.array(faces), process=False)


def _corners(mesh: Trimesh) -> set[frozenset[Any]]:
    return {frozenset(map(tuple, triangle.round(6).tolist())) for triangle in mesh.triangles}


# --- files --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "content",
    [
        f"OFF\n4 2 0\n{POINTS}3 0 1 2\n3 0 2 3\n",
        f"OFF4 2 0\n{POINTS}3 0 1 2\n3 0 2 3",  # glued, as in ModelNet40
        f"OFF\n4 1 0\n{POINTS}4 0 1 2 3\n",
    ],
)
def test_all_ways_to_write_a_mesh(tmp_path: Path, content: str) -> None:
    path = tmp_path / "mesh.off"
    path.write_bytes(content.encode())
    expected = clean_mesh(_mesh([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.5]], FACES))
    assert _corners(read_mesh(path)) == _corners(expected)


@pytest.mark.parametrize(
    "content",
    [
        "",
        "OFF\n3 1 0\n0 0 0\n1 nan 0\n1 1 0\n3 0 1 2\n",
        f"OFF\n4 2 0\n{POINTS}3 0 1 2\n",  # truncated within the faces
        "OFF\n3 1 0\n1 2 3\n1 2 3\n1 2 3\n3 0 1 2\n",  # a point
    ],
)
def test_broken_files_are_named(tmp_path: Path, content: str) -> None:
    path = tmp_path / "mesh.off"
    path.write_text(content, encoding="latin-1")
    with pytest.raises(DataError, match=rf"{re.escape(str(path))}: found .*expected a surface"):
        read_mesh(path)


# --- closed forms ------------------------------------------------------------------------------


def test_spheres_of_a_cube_match_the_closed_form() -> None:
    box = creation.box((5, 5, 5)).apply_translation((7, -3, 20))
    spheres = mesh_spheres(clean_mesh(box), SHAPE)
    half = RADIUS / math.sqrt(3)
    along = np.abs(RAYS).max(axis=-1)  # the share of the ray along the normal of the face it hits
    two, one = np.sort(np.abs(RAYS), axis=-1)[..., 1:].transpose(2, 0, 1)
    clear = one - two > 1e-6  # at the edges either face may be hit
    assert clear.mean() > 0.98
    expected = np.stack([1 - half / along, along, np.sqrt(1 - along**2)], axis=-1)
    for channels in (spheres[..., :3], spheres[..., 3:]):
        np.testing.assert_allclose(channels[clear], expected[clear], atol=2e-6)
        np.testing.assert_allclose(channels[..., 0], expected[..., 0], atol=2e-6)


@pytest.mark.parametrize("label", ["chair", "cup"])
def test_open_and_overlapping_meshes_against_a_slow_reference(label: str) -> None:
    mesh = clean_mesh(make_shape(5, label, 3))
    rays = RAYS.reshape(-1, 3)[::7]
    distances = hit_distances(rays, -rays, mesh.triangles)
    distance, triangle = distances.min(axis=1), distances.argmin(axis=1)
    found = mesh_spheres(mesh, SHAPE).reshape(-1, 6)[::7]
    hit = np.isfinite(distance)
    expected = np.where(hit, distance, 1)
    # Rays that pass an edge by a hair may be seen either way in float32.
    same = np.abs(found[:, 0] - expected) < 1e-4
    assert same.mean() > 0.998
    a, b, c = np.array(mesh.triangles).transpose(1, 0, 2)
    normals = np.cross(b - a, c - a)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    cosine = np.where(hit, np.abs(np.sum(normals[triangle] * rays, axis=1)), 0)
    right = np.abs(found[:, 1] - cosine) < 1e-6
    assert right.mean() > 0.97  # where two faces meet, either normal
    np.testing.assert_allclose(np.hypot(found[:, 1], found[:, 2]), hit | (found[:, 1] > 0))
    assert found.min() >= 0
    assert found[:, 0].max() < 2


# --- cleaning ----------------------------------------------------------------------------------


@pytest.mark.parametrize("scale", [1e-9, 1, 1e9])
def test_size_place_and_attitude_of_the_original_do_not_matter(scale: float) -> None:
    mesh = make_shape(0, "table", 2)
    moved = _mesh((mesh.vertices + 1.5) * scale, mesh.faces)
    np.testing.assert_allclose(clean_mesh(mesh).vertices, clean_mesh(moved).vertices, atol=1e-6)
    rotation = random_rotation(np.random.default_rng(0))
    rotated = clean_mesh(_mesh(mesh.vertices @ rotation.T, mesh.faces))
    np.testing.assert_allclose(rotated.vertices, clean_mesh(mesh).vertices @ rotation.T, atol=1e-6)
