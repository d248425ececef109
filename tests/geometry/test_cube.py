"""The faces of a cube: where their corners are, that they meet, who owns what."""

from __future__ import annotations

import math
import pickle
from dataclasses import FrozenInstanceError

import numpy as np
import pytest
from numpy.typing import NDArray

from tangent_train.errors import SettingError
from tangent_train.geometry import (
    FLIP_Y,
    CubeGrid,
    TangentGrid,
    equirect_directions,
    equirect_solid_angles,
    perspective_directions,
    rotation_about,
    xyz_to_lonlat,
)

TURN = rotation_about((1, 2, -3), 1.1)
FRONT, RIGHT, BACK, LEFT, UP, DOWN = range(6)

# Top left, top right, bottom left, bottom right, as seen from inside: y is right, z is up.
CORNERS = {
    FRONT: [(1, -1, 1), (1, 1, 1), (1, -1, -1), (1, 1, -1)],
    RIGHT: [(1, 1, 1), (-1, 1, 1), (1, 1, -1), (-1, 1, -1)],
    BACK: [(-1, 1, 1), (-1, -1, 1), (-1, 1, -1), (-1, -1, -1)],
    LEFT: [(-1, -1, 1), (1, -1, 1), (-1, -1, -1), (1, -1, -1)],
    UP: [(-1, -1, 1), (-1, 1, 1), (1, -1, 1), (1, 1, 1)],
    DOWN: [(1, -1, -1), (1, 1, -1), (-1, -1, -1), (-1, 1, -1)],
}

# The twelve edges of an unfolded cube: pixels of one face beside pixels of another.
ALL = slice(None)
BACKWARDS = slice(None, None, -1)
EDGES = [
    ((FRONT, ALL, -1), (RIGHT, ALL, 0)),
    ((RIGHT, ALL, -1), (BACK, ALL, 0)),
    ((BACK, ALL, -1), (LEFT, ALL, 0)),
    ((LEFT, ALL, -1), (FRONT, ALL, 0)),
    ((FRONT, 0, ALL), (UP, -1, ALL)),
    ((RIGHT, 0, ALL), (UP, BACKWARDS, -1)),
    ((BACK, 0, ALL), (UP, 0, BACKWARDS)),
    ((LEFT, 0, ALL), (UP, ALL, 0)),
    ((FRONT, -1, ALL), (DOWN, 0, ALL)),
    ((RIGHT, -1, ALL), (DOWN, ALL, -1)),
    ((BACK, -1, ALL), (DOWN, -1, BACKWARDS)),
    ((LEFT, -1, ALL), (DOWN, BACKWARDS, 0)),
]


def random_directions(count: int) -> NDArray[np.float64]:
    directions = np.random.default_rng(0).normal(size=(count, 3))
    return np.asarray(directions / np.linalg.norm(directions, axis=1, keepdims=True))


@pytest.mark.parametrize("dim", [2, 5, 16])
@pytest.mark.parametrize("face", CORNERS)
def test_the_outer_corners_of_the_pixels_are_the_corners_of_the_cube(face: int, dim: int) -> None:
    grid = CubeGrid(dim)
    first, last = -0.5, dim - 0.5
    expected = [(first, first), (last, first), (first, last), (last, last)]  # column, row
    np.testing.assert_allclose(grid.project(CORNERS[face], face), expected, atol=1e-12)


@pytest.mark.parametrize("dim", [2, 5, 16])
@pytest.mark.parametrize(("one", "other"), EDGES)
def test_pixels_at_an_edge_mirror_those_of_the_neighbour(
    one: tuple[int, slice, int], other: tuple[int, slice, int], dim: int
) -> None:
    grid = CubeGrid(dim)
    directions = grid.directions()
    normal = grid.centers_xyz[one[0]] - grid.centers_xyz[other[0]]  # of length √2
    mirrored = directions[one] - (directions[one] @ normal)[:, None] * normal
    np.testing.assert_allclose(directions[other], mirrored, atol=1e-14)


def test_a_row_of_the_front_by_hand() -> None:
    grid = CubeGrid(4)  # pixel centres at ±1/4 and ±3/4
    longitudes, latitudes = np.degrees(xyz_to_lonlat(grid.directions([FRONT])[0, 1])).T
    np.testing.assert_allclose(longitudes, [-36.86990, -14.03624, 14.03624, 36.86990], atol=1e-5)
    np.testing.assert_allclose(np.tan(np.radians(latitudes[0])), 0.25 / 1.25, atol=1e-12)
    assert grid.camera_matrix.tolist() == [[2, 0, 1.5], [0, 2, 1.5], [0, 0, 1]]


def test_ninety_degrees_between_outer_edges_and_less_between_centres() -> None:
    grid = CubeGrid(32)
    assert math.degrees(2 * math.atan(32 / 2 * grid.pitch)) == pytest.approx(90)
    corners = grid.directions([LEFT])[0][[0, 0], [0, -1]]
    between = math.degrees(math.acos(corners[0] @ corners[1]))
    assert grid.fov_deg == pytest.approx(between)
    assert CubeGrid(10**6).fov_deg == pytest.approx(math.degrees(math.acos(1 / 3)), abs=1e-3)


@pytest.mark.parametrize("rotation", [None, TURN])
def test_axes_are_those_of_cameras(rotation: NDArray[np.float64] | None) -> None:
    grid = CubeGrid(7, rotation)
    axes = grid.world_from_camera
    identity = np.broadcast_to(np.eye(3), axes.shape)
    np.testing.assert_allclose(axes @ axes.transpose(0, 2, 1), identity, atol=1e-14)
    # Mirrored on the sphere, proper in a right-handed room.
    np.testing.assert_allclose(np.linalg.det(axes), -1, atol=1e-14)
    np.testing.assert_allclose(np.linalg.det(FLIP_Y @ axes), 1, atol=1e-14)
    rays = perspective_directions(grid.camera_matrix, (7, 7))
    for face in range(6):
        world = rays @ axes[face].T
        np.testing.assert_allclose(grid.directions([face])[0], world, atol=1e-14)


def test_up_and_down_are_the_front_camera_tilted() -> None:
    axes = CubeGrid(4).world_from_camera
    tilt = rotation_about((0, 1, 0), -math.pi / 2)  # takes +x up to +z
    np.testing.assert_allclose(tilt @ axes[FRONT], axes[UP], atol=1e-15)
    np.testing.assert_allclose(tilt.T @ axes[FRONT], axes[DOWN], atol=1e-15)


@pytest.mark.parametrize("rotation", [None, TURN])
def test_every_direction_is_seen_by_its_owner_alone(
    rotation: NDArray[np.float64] | None,
) -> None:
    grid = CubeGrid(9, rotation)
    directions = random_directions(5000)
    places = grid.project(directions, np.arange(6)[:, None])
    seen = (np.abs(places - 4) < 4.5).all(axis=-1)
    np.testing.assert_array_equal(seen.sum(axis=0), 1)
    np.testing.assert_array_equal(grid.owners(directions), seen.argmax(axis=0))
    # The face of the largest coordinate, by hand.
    x, y, z = (directions @ grid.rotation if grid.rotation is not None else directions).T
    largest = np.stack([x, y, -x, -y, z, -z]).argmax(axis=0)
    np.testing.assert_array_equal(grid.owners(directions), largest)


@pytest.mark.parametrize("dim", [2, 15, 16])
def test_faces_own_all_of_their_pixels(dim: int) -> None:
    grid = CubeGrid(dim)
    owners = grid.owners(grid.directions())
    assert (owners == np.arange(6)[:, None, None]).all()


def test_every_face_owns_a_sixth_of_the_sphere() -> None:
    shape = (400, 800)
    owners = CubeGrid(8).owners(equirect_directions(shape))
    weights = np.broadcast_to(equirect_solid_angles(shape)[:, None], shape)
    owned = np.bincount(owners.ravel(), weights.ravel(), minlength=6)
    assert owned.sum() == pytest.approx(4 * math.pi)
    np.testing.assert_allclose(owned, 4 * math.pi / 6, rtol=2e-3)
    # The pixels of a face fill it: p² cos³ each, to the error of the midpoint rule.
    fine = CubeGrid(200)
    cosines = np.einsum("ijc,c->ij", fine.directions([UP])[0], fine.centers_xyz[UP])
    assert (fine.pitch**2 * cosines**3).sum() == pytest.approx(4 * math.pi / 6, rel=1e-4)


def test_neighbours_are_the_faces_that_share_an_edge() -> None:
    expected: dict[int, set[int]] = {face: set() for face in range(6)}
    for (one, *_), (other, *_) in EDGES:
        expected[one].add(other)
        expected[other].add(one)
    neighbors = CubeGrid(4).neighbors
    assert neighbors.shape == (6, 4)
    assert {face: set(around) for face, around in enumerate(neighbors.tolist())} == expected


@pytest.mark.parametrize("start", range(6))
def test_greedy_walk_over_neighbours_ends_at_the_owner(start: int) -> None:
    grid = CubeGrid(4, TURN)
    directions = np.concatenate([random_directions(2000), grid.centers_xyz])
    face = np.full(len(directions), start)
    for _ in range(2):  # the opposite face is two steps away
        candidates = np.concatenate([face[:, None], grid.neighbors[face]], axis=1)
        closeness = np.einsum("nkc,nc->nk", grid.centers_xyz[candidates], directions)
        face = candidates[np.arange(len(face)), closeness.argmax(axis=1)]
    np.testing.assert_array_equal(face, grid.owners(directions))


def test_rotation_turns_every_direction() -> None:
    plain, turned = CubeGrid(5), CubeGrid(5, TURN)
    np.testing.assert_allclose(turned.directions(), plain.directions() @ TURN.T, atol=1e-14)
    np.testing.assert_allclose(turned.centers_xyz, plain.centers_xyz @ TURN.T, atol=1e-14)


@pytest.mark.parametrize("grid", [CubeGrid(5, TURN.T), TangentGrid(0, 4, 20, TURN.T)])
def test_a_rotation_replaces_the_grids_own(grid: CubeGrid | TangentGrid) -> None:
    turned = grid.with_rotation(TURN)
    assert type(turned) is type(grid)
    assert turned != grid
    assert turned.with_rotation(TURN.T) == grid
    plain = grid.with_rotation(None)
    assert (plain.rotation, plain.dim) == (None, grid.dim)
    np.testing.assert_allclose(turned.directions([2]), plain.directions([2]) @ TURN.T, atol=1e-14)


@pytest.mark.parametrize("base_level", range(3))
def test_tangent_images_overlap_and_the_faces_of_a_cube_do_not(base_level: int) -> None:
    directions = np.concatenate([random_directions(5000), np.array(CORNERS[UP]) / math.sqrt(3)])
    least = TangentGrid.least_dim(base_level, base_level + 5)
    for grid in (TangentGrid(base_level, base_level + 5, least), CubeGrid(32)):
        places = grid.project(directions, grid.owners(directions))
        beyond = np.abs(places - (grid.dim - 1) / 2).max() - grid.dim / 2
        assert grid.overlapping == bool(beyond < -0.4)


def test_grids_are_values() -> None:
    different = [CubeGrid(32), CubeGrid(33), CubeGrid(32, TURN), CubeGrid(32, TURN.T)]
    assert len({*different, TangentGrid(0, 5)}) == 5
    assert CubeGrid(32, TURN) == CubeGrid(32, TURN.tolist())
    assert hash(CubeGrid(32, TURN)) == hash(CubeGrid(32, TURN.tolist()))
    assert CubeGrid(32) != TangentGrid(0, 5, 32)
    assert CubeGrid(32) != (32, None)
    assert pickle.loads(pickle.dumps(CubeGrid(32, TURN))) == CubeGrid(32, TURN)


def test_grids_cannot_change() -> None:
    grid = CubeGrid(4, TURN)
    with pytest.raises(FrozenInstanceError):
        grid.dim = 3  # type: ignore[misc]
    for array in (grid.rotation, grid.world_from_camera, grid.centers_xyz, grid.neighbors):
        with pytest.raises(ValueError, match="read-only"):
            array[0, 0] = 5  # type: ignore[index]


@pytest.mark.parametrize("dim", [1, 0, -4, 8.5, 8.0, "8", True])
def test_impossible_sides_are_refused(dim: int) -> None:
    with pytest.raises(SettingError, match=r"dim: found .*; expected a whole number, 2 or more"):
        CubeGrid(dim)


@pytest.mark.parametrize("rotation", [np.diag([1.0, 1, -1]), 2 * np.eye(3), np.eye(2)])
def test_impossible_rotations_are_refused(rotation: NDArray[np.float64]) -> None:
    with pytest.raises(SettingError, match="rotation: found"):
        CubeGrid(4, rotation)


@pytest.mark.parametrize("faces", [[6], [-1], [0.5], [[0, 1]]])
def test_impossible_faces_are_refused(faces: list[int]) -> None:
    with pytest.raises(SettingError, match=r"faces: found .*; expected indices 0 to 5"):
        CubeGrid(4).directions(faces)
