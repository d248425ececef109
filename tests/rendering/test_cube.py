"""Cube maps: rendered as `tests.rendering.cube_reference` does, to the panorama and back."""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from tangent_train.errors import SettingError
from tangent_train.geometry import CubeGrid, equirect_directions, rotation_about
from tangent_train.rendering import (
    Interpolation,
    equirect_to_tangent,
    tables,
    tangent_to_equirect,
    tangent_to_labels,
)
from tests.rendering.cube_reference import ReferenceCube
from tests.rendering.reference import (
    Array,
    certain_labels,
    certain_nearest,
    panorama_lonlat,
    to_xyz,
)

TURN = rotation_about((1, -2, 0.5), 2.3)


class Case(NamedTuple):
    """A cube and a panorama size that is not its own."""

    dim: int
    shape: tuple[int, int]
    turned: bool = False

    @property
    def ours(self) -> CubeGrid:
        return CubeGrid(self.dim, TURN if self.turned else None)

    @property
    def theirs(self) -> ReferenceCube:
        return ReferenceCube(self.dim, TURN) if self.turned else ReferenceCube(self.dim)


CASES = [
    Case(16, (32, 64)),
    Case(16, (32, 64), turned=True),
    Case(25, (50, 100)),  # odd: the poles, ±90° and ±180° are at pixel centres
    Case(25, (33, 67), turned=True),  # half a turn is no whole column
    Case(9, (63, 126)),  # too small for the compiled kernel
    Case(40, (6, 12)),  # columns 1, 4, 7 and 10 are on edges of the cube
]


@pytest.fixture(params=CASES, ids=str)
def case(request: pytest.FixtureRequest) -> Case:
    assert isinstance(request.param, Case)
    return request.param


def noise(*shape: int) -> Array:
    """White noise in 0 to 1: any pixel fetched from a wrong place shows."""
    return np.random.default_rng(0).random(shape)


def waves(shape: tuple[int, int]) -> Array:
    """A smooth panorama ``(H, W, 3)`` in 0 to 1, smooth across the seam and the poles too."""
    x, y, z = np.moveaxis(to_xyz(panorama_lonlat(shape)), -1, 0)
    channels = [np.sin(4 * x + y), np.cos(3 * y - 2 * z), np.sin(5 * z + 2 * x * y)]
    return np.asarray((np.stack(channels, axis=-1) + 1) / 2)


@lru_cache
def certain_pixels(case: Case, interpolation: Interpolation) -> NDArray[np.bool_]:
    """Pixels ``(6, d, d)`` that do not hang on the rounding of a position.

    The very pole has every longitude.
    """
    lonlat = np.stack([case.theirs.lonlat(face) for face in range(6)])
    certain = np.abs(lonlat[..., 1]) < np.pi / 2 - 1e-9
    if interpolation == "nearest":
        certain &= certain_nearest(lonlat, case.shape, margin=1e-4)
    assert certain.mean() > 0.9
    return np.asarray(certain)


@pytest.mark.parametrize("interpolation", ["bilinear", "nearest"])
def test_faces_of_noise(case: Case, interpolation: Interpolation) -> None:
    image = noise(*case.shape, 3)
    expected = case.theirs.forward(image, interpolation)
    certain = certain_pixels(case, interpolation)
    for dtype, tolerance in ((torch.float64, 1e-9), (torch.float32, 2e-4)):
        tensor = torch.from_numpy(image).movedim(-1, 0).to(dtype)
        faces = equirect_to_tangent(tensor, case.ours, interpolation=interpolation)
        assert (faces.dtype, faces.shape) == (dtype, (6, 3, case.dim, case.dim))
        error = np.abs(faces.movedim(1, -1).double().numpy() - expected)
        assert error[certain].max() < tolerance
    array = equirect_to_tangent(image, case.ours, interpolation=interpolation)
    assert np.abs(array - expected)[certain].max() < 1e-9


def test_panorama_of_noise(case: Case) -> None:
    images = noise(6, case.dim, case.dim, 3)
    clear = case.theirs.clear(case.shape)
    assert clear.mean() > 0.75
    expected = case.theirs.backward(images, case.shape)[clear]
    for dtype, tolerance in ((torch.float64, 1e-9), (torch.float32, 2e-5)):
        tensor = torch.from_numpy(images).movedim(-1, 1).to(dtype)
        panorama = tangent_to_equirect(tensor, case.ours, case.shape)
        assert (panorama.dtype, panorama.shape) == (dtype, (3, *case.shape))
        error = np.abs(panorama.movedim(0, -1).double().numpy()[clear] - expected)
        assert error.max() < tolerance


@pytest.mark.parametrize("num_classes", [5, 19])  # one vector of the compiled kernel, and two
def test_labels_are_the_best_interpolated_scores(case: Case, num_classes: int) -> None:
    scores = noise(6, case.dim, case.dim, num_classes)
    rendered = case.theirs.backward(scores, case.shape)
    clear = case.theirs.clear(case.shape)
    for dtype, margin in ((torch.float64, 1e-9), (torch.float32, 4e-5)):
        tensor = torch.from_numpy(scores).movedim(-1, 1).to(dtype)
        labels = tangent_to_labels(tensor, case.ours, case.shape).numpy()
        certain = clear & certain_labels(rendered, margin)
        assert certain.mean() > 0.75
        np.testing.assert_array_equal(labels[certain], rendered.argmax(axis=-1)[certain])


@pytest.mark.parametrize("shape", [(6, 12), (33, 67)])
@pytest.mark.parametrize("dim", [2, 9, 16])
def test_up_to_the_edge_a_pixel_takes_the_values_of_its_owner_alone(
    dim: int, shape: tuple[int, int]
) -> None:
    """Beyond the outermost pixel centres, the outermost pixels go on: no mixing, no NaN."""
    grid = CubeGrid(dim)
    table = tables.image_table(grid, shape, np.dtype(np.float64), "nearest", slice(0, shape[0]))
    reach = np.abs(np.stack([table.u, table.v]) - (dim - 1) / 2).max()
    assert (dim - 1) / 2 < reach <= dim / 2 + 1e-9, "some are between centre and edge"
    images = torch.arange(1.0, 7.0)[:, None, None, None].expand(6, 1, dim, dim)
    panorama = tangent_to_equirect(images, grid, shape)[0].numpy()
    np.testing.assert_allclose(panorama, table.face[0] + 1.0, atol=1e-5)
    scores = torch.eye(6)[:, :, None, None].expand(6, 6, dim, dim)
    for kind in (torch.float32, torch.float64):  # compiled and torch
        labels = tangent_to_labels(scores.to(kind), grid, shape).numpy()
        np.testing.assert_array_equal(labels, table.face[0])
    x, y, z = np.moveaxis(equirect_directions(shape), -1, 0)
    coordinates = np.stack([x, y, -x, -y, z, -z])
    owned = np.take_along_axis(coordinates, table.face.astype(int), axis=0)[0]
    np.testing.assert_allclose(owned, coordinates.max(axis=0), atol=1e-12)


def test_the_pole_is_in_the_middle_of_the_up_face() -> None:
    rows = np.repeat(np.arange(64, dtype=np.float32)[:, None], 128, axis=1)
    up, down = equirect_to_tangent(rows, CubeGrid(5), [4, 5])
    for face, pole in ((up, 0.0), (63 - down, 0.0)):
        assert face[2, 2] == pole
        for turned in (face.T, face[::-1], face[:, ::-1]):
            np.testing.assert_allclose(turned, face, atol=1e-3)
        # A pixel two fifths from the middle: atan 0.4 below the pole.
        assert face[2, 3] == pytest.approx(np.degrees(np.arctan(0.4)) / 180 * 64 - 0.5, abs=1e-3)


@pytest.mark.parametrize("render", [tangent_to_equirect, tangent_to_labels])
@pytest.mark.parametrize("kind", [np.asarray, torch.as_tensor])
def test_faces_cannot_be_feathered(render: Any, kind: Any) -> None:
    images = kind(np.zeros((6, 16, 16, 16), np.float32))
    with pytest.raises(SettingError, match="blend: found 'feather'; expected 'nearest' for images"):
        render(images, CubeGrid(16), (32, 64), "feather")
