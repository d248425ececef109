"""Tangent images, cube faces and horizontal views, by other formulas and by brute force."""

from __future__ import annotations

import math
import pickle
from functools import lru_cache
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import SphericalVoronoi

from tangent_train.errors import SettingError
from tangent_train.geometry import (
    CubeGrid,
    PinholeGrid,
    RingGrid,
    TangentGrid,
    equirect_directions,
    lonlat_to_xyz,
    rotation_about,
    xyz_to_lonlat,
)
from tangent_train.rendering.tables import owners
from tests.geometry.directions import angle_deg, random_directions

ROTATION = rotation_about((1, 2, -3), 1.1)
RINGS = [{"pitch": pitch, "views": 6} for pitch in (0, 45, -45)]


@pytest.mark.parametrize("rotation", [None, ROTATION])
def test_project_is_the_inverse_of_directions(rotation: NDArray[np.float64] | None) -> None:
    grid = TangentGrid(1, 5, dim=20, rotation=rotation)
    faces = [0, 5, 42, 79]
    pixels = grid.project(7.0 * grid.directions(faces), np.array(faces)[:, None, None])
    rows, columns = np.mgrid[:20, :20]
    expected = np.broadcast_to(np.stack([columns, rows], axis=-1), pixels.shape)
    np.testing.assert_allclose(pixels, expected, atol=1e-11)
    homogeneous = grid.directions([5])[0] @ grid.world_from_camera[5] @ grid.camera_matrix.T
    np.testing.assert_allclose(homogeneous[..., :2] / homogeneous[..., 2:], expected[0], atol=1e-11)
    assert grid.directions([]).shape == (0, 20, 20, 3)


def test_pixels_need_not_be_square() -> None:
    """Closed form of a camera with two focal lengths, which looks up at a longitude of 90°."""
    size, fov_deg, up_deg = (30, 40), (62, 48), 36
    rings = [{"pitch": up_deg, "views": 4}]
    grid = RingGrid(rings, fov_deg, size, square_pixels=False, is_complete=False)
    for lon_deg, lat_deg in ((90, 36), (75, 20), (112, 55)):
        lon, lat, up = np.radians((lon_deg - 90, lat_deg, up_deg))
        ahead = math.cos(lat) * math.cos(lon)
        z = ahead * math.cos(up) + math.sin(lat) * math.sin(up)
        x, y = math.cos(lat) * math.sin(lon), ahead * math.sin(up) - math.sin(lat) * math.cos(up)
        focal = [n / 2 / math.tan(math.radians(fov / 2)) for n, fov in ((40, 62), (30, 48))]
        expected = focal[0] * x / z + 39 / 2, focal[1] * y / z + 29 / 2
        found = grid.project(lonlat_to_xyz(np.radians((lon_deg, lat_deg))), 1)
        np.testing.assert_allclose(found, expected, atol=1e-11)
    rows, columns = np.mgrid[:30, :40]
    pixels = grid.project(grid.directions([1])[0], 1)
    np.testing.assert_allclose(pixels, np.stack([columns, rows], axis=-1), atol=1e-11)
    assert np.degrees(2 * np.arctan(grid.half_size)) == pytest.approx(fov_deg)
    assert np.degrees(2 * np.arctan(grid.resized((7, 8)).half_size)) == pytest.approx(fov_deg)


def test_grids_are_compared_by_value() -> None:
    grid, cube = TangentGrid(0, 5), CubeGrid(32)
    different: list[PinholeGrid] = [
        grid,
        TangentGrid(1, 5),
        TangentGrid(0, 6),
        TangentGrid(0, 5, 30),
    ]
    different += [cube, CubeGrid(33), CubeGrid(32, margin=1), RingGrid(RINGS, (100, 100), (8, 8))]
    different += [RingGrid(RINGS, (100, 90), (8, 8), square_pixels=False)]
    different += [grid.with_rotation(ROTATION), cube.with_rotation(ROTATION)]
    different += [grid.resized((33, 33)), grid.subset([3, 4]), grid.subset([3, 5])]
    assert len(set(different)) == len({hash(grid) for grid in different}) == len(different)
    for one in different:
        again = pickle.loads(pickle.dumps(one))
        assert (again, hash(again)) == (one, hash(one))
    assert TangentGrid(0, 5) == TangentGrid(0, 5, 32)
    assert CubeGrid(32, ROTATION) == CubeGrid(32, ROTATION.tolist())
    assert CubeGrid(32).widened(1) == CubeGrid(34, margin=1) != CubeGrid(34)
    assert CubeGrid(32) != (32, None)


@pytest.mark.parametrize(
    "original", [CubeGrid(8, ROTATION), TangentGrid(1, 5), TangentGrid(0, 4, 20, ROTATION)]
)
@pytest.mark.parametrize("dim", [2, 33])
def test_a_resized_grid_has_other_pixels(original: CubeGrid | TangentGrid, dim: int) -> None:
    grid = original.resized((dim, dim))
    assert grid.dim == dim
    assert grid.dim * grid.pitch == pytest.approx(original.dim * original.pitch, rel=1e-15)
    assert grid.num_images == original.num_images
    assert grid.is_overlapping is original.is_overlapping
    np.testing.assert_array_equal(grid.rotation, original.rotation)
    np.testing.assert_array_equal(grid.neighbors, original.neighbors)
    np.testing.assert_array_equal(grid.world_from_camera, original.world_from_camera)
    assert grid.with_rotation(ROTATION.T) == original.with_rotation(ROTATION.T).resized((dim, dim))
    # The outer edges agree: the middle of d pixels is (d − 1)/2.
    edges = original.project(grid.directions([3])[0, 0, 0], 3)
    np.testing.assert_allclose((edges + 0.5) * dim / original.dim, 0.5, atol=1e-9)


@lru_cache
def voronoi_extent(base_level: int) -> float:
    """Largest |x| or |y| of a cell corner on its own tangent plane, by textbook projection."""
    centers = TangentGrid(base_level, base_level + 6).centers_xyz
    voronoi = SphericalVoronoi(centers, threshold=1e-9)
    cell = np.repeat(np.arange(len(centers)), [len(region) for region in voronoi.regions])
    corners = voronoi.vertices[np.concatenate(voronoi.regions).astype(int)]
    (lon_0, lat_0), (lon, lat) = xyz_to_lonlat(centers)[cell].T, xyz_to_lonlat(corners).T
    cos_c = np.sin(lat_0) * np.sin(lat) + np.cos(lat_0) * np.cos(lat) * np.cos(lon - lon_0)
    x = np.cos(lat) * np.sin(lon - lon_0) / cos_c
    y = (np.cos(lat_0) * np.sin(lat) - np.sin(lat_0) * np.cos(lat) * np.cos(lon - lon_0)) / cos_c
    return float(np.abs([x, y]).max())


@pytest.mark.parametrize(("base_level", "finer"), [(0, 3), (1, 4), (2, 6), (3, 3), (4, 4)])
def test_least_dim_covers_the_voronoi_cells_exactly(base_level: int, finer: int) -> None:
    level = base_level + finer
    pitch = TangentGrid(base_level, level).pitch
    least = math.ceil(2 * voronoi_extent(base_level) / pitch) + 1
    with pytest.raises(SettingError, match=f"dim: found {least - 1}; expected at least {least} "):
        TangentGrid(base_level, level, least - 1)
    assert TangentGrid(base_level, level, least).half_extent >= voronoi_extent(base_level)
    assert TangentGrid.least_dim(base_level, level) == least


def test_the_width_is_the_angle_between_outer_pixel_edges() -> None:
    for base_level, width_deg in enumerate((95.82, 57.94, 32.83, 17.01, 8.59)):
        grid = TangentGrid(base_level, 10)
        edges = (np.array([-0.5, grid.dim - 0.5]) - grid.camera_matrix[0, 2]) * grid.pitch
        assert grid.width_deg == pytest.approx(np.degrees(np.ptp(np.arctan(edges))))
        assert grid.width_deg == pytest.approx(width_deg, abs=0.005)


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


@pytest.mark.parametrize("dim", [5, 16])
@pytest.mark.parametrize("face", CORNERS)
def test_the_outer_corners_of_the_pixels_are_the_corners_of_the_cube(face: int, dim: int) -> None:
    grid = CubeGrid(dim)
    first, last = -0.5, dim - 0.5
    expected = [(first, first), (last, first), (first, last), (last, last)]  # column, row
    np.testing.assert_allclose(grid.project(CORNERS[face], face), expected, atol=1e-12)


@pytest.mark.parametrize("rotation", [None, ROTATION])
def test_only_the_owner_contains_a_direction(
    rotation: NDArray[np.float64] | None,
) -> None:
    grid = CubeGrid(9, rotation)
    directions = random_directions(5000)
    positions = grid.project(directions, np.arange(6)[:, None])
    seen = (np.abs(positions - 4) < 4.5).all(axis=-1)
    np.testing.assert_array_equal(seen.sum(axis=0), 1)
    np.testing.assert_array_equal(grid.owners(directions), seen.argmax(axis=0))
    # The face of the largest coordinate, by hand.
    x, y, z = (directions @ grid.rotation if grid.rotation is not None else directions).T
    largest = np.stack([x, y, -x, -y, z, -z]).argmax(axis=0)
    np.testing.assert_array_equal(grid.owners(directions), largest)


def test_a_margin_shows_what_is_beyond_the_face() -> None:
    plain, wide = CubeGrid(8, ROTATION), CubeGrid(14, ROTATION, margin=3)
    np.testing.assert_allclose(
        wide.directions()[:, 3:-3, 3:-3], plain.directions(), rtol=0, atol=1e-14
    )
    assert (wide.pitch, wide.is_overlapping, plain.is_overlapping) == (plain.pitch, True, False)
    directions = random_directions(500)
    np.testing.assert_array_equal(wide.owners(directions), plain.owners(directions))


STANDARD = ((0, 8), (40, 5), (-40, 5))


def grid_of(
    rings: tuple[tuple[float, int], ...],
    fov: tuple[float, float] = (100, 100),
    size: tuple[int, int] = (16, 16),
    **settings: Any,
) -> RingGrid:
    return RingGrid([{"pitch": pitch, "views": n} for pitch, n in rings], fov, size, **settings)


@pytest.mark.parametrize("rotation", [None, ROTATION])
def test_views_are_yawed_and_pitched_but_not_rolled(rotation: NDArray[np.float64] | None) -> None:
    """Compared with a camera at longitude 0 that is pitched, then yawed around the vertical."""
    grid = grid_of(((0, 8), (50, 4), (-50, 4)), (70, 90), (20, 15), rotation=rotation)
    tangent = math.tan(math.radians(45)) * 2 / 20  # the vertical field of view is decisive
    assert grid.pitch == pytest.approx(tangent)
    view = 0
    for pitch_deg, views in ((0, 8), (50, 4), (-50, 4)):
        for yaw_deg in np.arange(views) * 360 / views:
            around = rotation_about((0, 0, 1), math.radians(yaw_deg))
            camera = around @ rotation_about((0, 1, 0), -math.radians(pitch_deg))
            for row, column in ((0, 0), (19, 14), (3, 11)):
                seen = [1, (column - 7) * tangent, -(row - 9.5) * tangent]
                expected = (np.eye(3) if rotation is None else rotation) @ camera @ seen
                found = grid.directions([view])[0, row, column]
                assert angle_deg(found, expected) < 1e-9
                pixel = grid.project(3 * expected, view)
                np.testing.assert_allclose(pixel, (column, row), atol=1e-9)
            view += 1
    assert view == grid.num_images


def test_rings_can_be_a_cube() -> None:
    order = [0, 1, 2, 3, 5, 4]
    rings = grid_of(((0, 4), (-90, 1), (90, 1)), (90, 90), (8, 8))
    np.testing.assert_allclose(rings.directions(order), CubeGrid(8).directions(), atol=1e-12)
    assert rings.is_overlapping is False
    assert grid_of(((0, 4), (90, 1), (-90, 1)), (91, 91)).is_overlapping


GRIDS = [
    grid_of(STANDARD),
    grid_of(((10, 7), (90, 1), (-40, 3)), (150, 110), rotation=ROTATION),
    TangentGrid(1, 5).subset([3, 4, 17, 40, 41, 79]),
    CubeGrid(8, ROTATION).subset([0, 1, 2, 3]),  # centers in a plane
    TangentGrid(0, 5).subset([7]),
    TangentGrid(0, 5).subset([7, 3]),
    grid_of(((0, 4), (90, 3), (-90, 1))),  # three views of one direction
]


@pytest.mark.parametrize("grid", GRIDS)
def test_owners_are_the_nearest_centers(grid: PinholeGrid) -> None:
    nearness = equirect_directions((45, 90)) @ grid.centers_xyz.T
    found = owners(grid, (45, 90))
    of_owner = np.take_along_axis(nearness, found[..., None].astype(int), axis=-1)[..., 0]
    np.testing.assert_allclose(of_owner, nearness.max(axis=-1), atol=1e-12)


@pytest.mark.parametrize("seed", range(3))
def test_coverage_agrees_with_random_directions(seed: int) -> None:
    """Grids around the smallest field of view that covers the sphere, found by bisection."""
    rng = np.random.default_rng(seed)
    rings = ((0, 6), (float(rng.uniform(35, 60)), 4), (float(rng.uniform(-60, -35)), 5))
    ratio = float(rng.uniform(0.8, 1.2))

    def makes(fov: float, by_owners: bool) -> PinholeGrid | None:
        try:
            return grid_of(rings, (fov, 1), (round(100 * ratio), 100), by_owners=by_owners)
        except SettingError:
            return None

    directions = random_directions(100_000, seed)
    for by_owners in (True, False):
        low, high = 40.0, 140.0
        while high - low > 0.5:
            middle = (low + high) / 2
            low, high = (low, middle) if makes(middle, by_owners) else (middle, high)
        for fov, is_covered in ((low - 1, False), (high + 1, True)):
            grid = makes(high, by_owners)
            assert grid is not None
            pitch = 2 * math.tan(math.radians(fov / 2)) / 100
            grid = PinholeGrid(grid.world_from_camera, grid.size, pitch)
            pixels = grid.project(directions[:, None], np.arange(15))
            outer = np.array(grid.size[::-1]) / 2
            with np.errstate(invalid="ignore"):
                shown = (np.abs(pixels - outer + 0.5) <= outer).all(axis=-1)
            if by_owners:
                owner = (directions @ grid.centers_xyz.T).argmax(axis=1)
                shown = np.take_along_axis(shown, owner[:, None], axis=1)
            assert bool(np.any(shown, axis=1).all()) is is_covered


@pytest.mark.parametrize(
    ("rings", "fov", "message"),
    [
        (((0, 8),), (100, 100), r"8 views that miss longitude .*°, latitude -?\d\d°; expected"),
        (((0, 4), (90, 1), (-90, 1)), (89, 89), r"6 views that miss longitude -?\d+°, latitude "),
    ],
)
@pytest.mark.parametrize("by_owners", [True, False])
def test_gaps_are_refused(rings: Any, fov: Any, message: str, by_owners: bool) -> None:
    with pytest.raises(SettingError, match=f"views: found {message}"):
        grid_of(rings, fov, by_owners=by_owners)


def test_a_direction_may_be_shown_by_another_view_than_its_owner() -> None:
    """Narrow views overlap far more above and below than at their sides."""
    rings, fov, size = ((0, 8), (75, 4), (-75, 4)), (47.0, 124.0), (52, 12)
    grid_of(rings, fov, size, by_owners=False)
    with pytest.raises(SettingError, match=r"nearest center \(blend=nearest\)"):
        grid_of(rings, fov, size, by_owners=True)
