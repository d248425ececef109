"""All geometry is computed in float64 for batches of any shape, whatever numbers come in."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from tangent_train.geometry import (
    CubeGrid,
    PanoramaPose,
    TangentGrid,
    checked_rotation,
    equirect_elevations,
    equirect_to_lonlat,
    lonlat_to_equirect,
    lonlat_to_xyz,
    normalize_camera,
    perspective_directions,
    rotation_about,
    shift_range,
    xyz_to_lonlat,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

WHOLE = np.array([[[1, 2, 2], [0, -3, 4], [-2, 1, 0]], [[3, 0, 0], [0, 0, -1], [1, 1, 1]]])
"""Whole numbers ``(2, 3, 3)``, which float32 holds as they are."""
CAMERA = np.array([[300, 0, 100], [0, 280, 90], [0, 0, 1]])
QUARTER = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]])
POSE = PanoramaPose(rotation_about((1, 2, 3), 0.7), (0.1, 0.2, 0.3))

FUNCTIONS: dict[str, Callable[[Any], Any]] = {
    "equirect_to_lonlat": lambda n: equirect_to_lonlat(n[..., :2], (7, 14)),
    "lonlat_to_equirect": lambda n: lonlat_to_equirect(n[..., :2], (7, 14)),
    "lonlat_to_xyz": lambda n: lonlat_to_xyz(n[..., :2]),
    "xyz_to_lonlat": xyz_to_lonlat,
    "points_m": lambda n: POSE.points_m(n, abs(n[..., 0])),
    "seen": POSE.seen,
    "CubeGrid.project": lambda n: CubeGrid(8).project(n, 1),
    "TangentGrid.project": lambda n: TangentGrid(0, 4).project(n, np.array([[3], [4]])),
}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_any_numbers_are_taken_as_float64(name: str) -> None:
    function = FUNCTIONS[name]
    expected = function(WHOLE.astype(np.float64))
    for kind in (np.float32, np.float16):
        found = function(WHOLE.astype(kind))
        _same(found, expected)


@pytest.mark.parametrize("name", ["equirect_to_lonlat", "lonlat_to_xyz", "seen"])
def test_batches_are_what_their_parts_are(name: str) -> None:
    whole = FUNCTIONS[name](WHOLE)
    if isinstance(whole, tuple):
        whole = whole[0]
    for index in np.ndindex(*WHOLE.shape[:2]):
        part = FUNCTIONS[name](WHOLE[index].astype(np.float64))
        np.testing.assert_array_equal(whole[index], part[0] if isinstance(part, tuple) else part)


def test_lonlat_of_batches_comes_back() -> None:
    lonlat = WHOLE[..., :2] / 8
    there = equirect_to_lonlat(lonlat_to_equirect(lonlat, (9, 18)), (9, 18))
    np.testing.assert_allclose(there, lonlat, atol=1e-12)


def _same(found: Any, expected: Any) -> None:
    found = found if isinstance(found, tuple) else (found,)
    expected = expected if isinstance(expected, tuple) else (expected,)
    for one, other in zip(found, expected, strict=True):
        assert one.dtype == np.float64
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("kind", [int, np.float32, list])
def test_matrices_of_any_numbers(kind: Any) -> None:
    def given(matrix: NDArray[Any]) -> Any:
        return matrix.tolist() if kind is list else matrix.astype(kind)

    exact = CAMERA.astype(np.float64)
    _same(perspective_directions(given(CAMERA), (4, 6)), perspective_directions(exact, (4, 6)))
    _same(shift_range(given(CAMERA), (180, 210), 20), shift_range(exact, (180, 210), 20))
    shift = (0.25, -1.5)
    expected = normalize_camera(exact, (180, 210), 20, 16, shift)
    _same(tuple(normalize_camera(given(CAMERA), (180, 210), 20, 16, shift)), tuple(expected))
    _same(
        tuple(normalize_camera(exact, (180, 210), 20, 16, np.float32(shift))),  # type: ignore[arg-type]
        tuple(expected),
    )
    _same(checked_rotation(given(QUARTER)), QUARTER.astype(np.float64))
    pose = PanoramaPose(given(QUARTER), [1, 2, 3])
    _same((pose.world_from_panorama, pose.location_m), (QUARTER * 1.0, np.array([1.0, 2, 3])))
    _same(
        pose.moved(given(QUARTER), np.array([1, 2, 4], np.float32)).location_m,
        np.array([0.0, 0, -1]),
    )


def test_elevations_are_float32_of_float64() -> None:
    up = rotation_about((1, 2, 0), 0.4)[2]
    lonlat = equirect_to_lonlat(np.stack(np.meshgrid(range(12), range(6)), axis=-1), (6, 12))
    found = equirect_elevations((6, 12), up.tolist())
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, lonlat_to_xyz(lonlat) @ up, atol=2e-7)
