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
    CubemapRepresentation,
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


def test_faces_of_8_bit_images_and_labels(case: Case) -> None:
    image = np.round(255 * waves(case.shape)).astype(np.uint8)
    expected = case.theirs.forward(image.astype(np.float64))
    steps = sum(np.abs(np.diff(image.astype(float), axis=axis)).max() for axis in (0, 1))
    certain = certain_pixels(case, "bilinear")
    error = np.abs(equirect_to_tangent(image, case.ours) - expected)[certain]
    assert error.max() < 0.501 + steps / 64  # OpenCV 4 rounds positions to 1/32 px
    labels = (noise(*case.shape) * 256).astype(np.uint8)
    nearest = case.theirs.forward(labels[..., None].astype(np.float64), "nearest")[..., 0]
    certain = certain_pixels(case, "nearest")
    found = equirect_to_tangent(labels, case.ours, interpolation="nearest")
    np.testing.assert_array_equal(found[certain], nearest[certain])


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


@pytest.mark.parametrize("rotation", [None, TURN])
@pytest.mark.parametrize("dim", [31, 32])
def test_smooth_panorama_survives_the_round_trip(
    dim: int, rotation: NDArray[np.float64] | None
) -> None:
    shape = (64, 128)
    image = waves(shape)
    grid = CubeGrid(dim, rotation)
    error = np.abs(tangent_to_equirect(equirect_to_tangent(image, grid), grid, shape) - image)
    # Linear interpolation errs by f″h²/8: f″ up to 15 both ways, h of either image.
    between = 30 * np.hypot(2 * np.pi / shape[1], grid.pitch) ** 2 / 8
    # Within half a pixel of an edge the outermost pixel is repeated: f′ up to 3 each way.
    assert error.max() < between + 6 * grid.pitch / 2
    table = tables.image_table(grid, shape, np.dtype(np.float64), "nearest", slice(0, shape[0]))
    inner = (np.abs(np.stack([table.u, table.v]) - (dim - 1) / 2) < (dim - 1) / 2).all(axis=(0, 1))
    assert inner.mean() > 0.9
    assert error[inner].max() < between
    for part in (error[:, [0, -1]], error[[0, -1]]):  # seam and poles are inside of faces
        assert rotation is not None or np.median(part) < 1e-2


def test_the_back_face_looks_at_the_seam() -> None:
    columns = np.tile(np.arange(128, dtype=np.uint8), (64, 1))
    back = equirect_to_tangent(columns, CubeGrid(4), [2], "nearest")[0]
    # tan of the angle to the back is ∓3/4 and ∓1/4: 36.87° is 13.1 columns of 2.8125°, 14.04° 5.0.
    assert (back == [114, 123, 4, 13]).all()


def test_the_pole_is_in_the_middle_of_the_up_face() -> None:
    rows = np.repeat(np.arange(64, dtype=np.float32)[:, None], 128, axis=1)
    up, down = equirect_to_tangent(rows, CubeGrid(5), [4, 5])
    for face, pole in ((up, 0.0), (63 - down, 0.0)):
        assert face[2, 2] == pole
        for turned in (face.T, face[::-1], face[:, ::-1]):
            np.testing.assert_allclose(turned, face, atol=1e-3)
        # A pixel two fifths from the middle: atan 0.4 below the pole.
        assert face[2, 3] == pytest.approx(np.degrees(np.arctan(0.4)) / 180 * 64 - 0.5, abs=1e-3)


@pytest.mark.parametrize("shape", [(32, 64), (31, 63)])
@pytest.mark.parametrize("dim", [3, 16, 21])
def test_one_class_everywhere(dim: int, shape: tuple[int, int]) -> None:
    """No other value anywhere: not at the poles, not at the seam, not between faces."""
    grid = CubeGrid(dim)
    panorama = np.full(shape, 3, np.uint8)
    for interpolation in ("nearest", "bilinear"):
        images = equirect_to_tangent(panorama, grid, interpolation=interpolation)
        assert (images == 3).all()
    scores = np.eye(5, dtype=np.float32)[images].transpose(0, 3, 1, 2)
    assert (tangent_to_labels(scores, grid, shape) == 3).all()


def test_gradients() -> None:
    images = torch.rand(6, 1, 4, 4, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(
        lambda x: tangent_to_equirect(x, CubeGrid(4), (6, 12)), images, fast_mode=True
    )
    panorama = torch.rand(1, 6, 12, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(
        lambda x: equirect_to_tangent(x, CubeGrid(4), [0, 2, 4]), panorama, fast_mode=True
    )


@pytest.mark.parametrize("render", [tangent_to_equirect, tangent_to_labels])
@pytest.mark.parametrize("kind", [np.asarray, torch.as_tensor])
def test_faces_cannot_be_feathered(render: Any, kind: Any) -> None:
    images = kind(np.zeros((6, 16, 16, 16), np.float32))
    with pytest.raises(SettingError, match="blend: found 'feather'; expected 'nearest' for images"):
        render(images, CubeGrid(16), (32, 64), "feather")


@pytest.mark.parametrize("dim", [None, 25])
def test_labels_of_the_representation(dim: int | None) -> None:
    representation = CubemapRepresentation(level=4, dim=dim)
    reference, shape = ReferenceCube(dim or 16), (32, 64)
    scores = noise(6, reference.dim, reference.dim, 13)
    tensor = torch.from_numpy(scores).movedim(-1, 1).float()
    labels = representation.to_labels(tensor, shape).numpy()
    rendered = reference.backward(scores, shape)
    certain = reference.clear(shape) & certain_labels(rendered, 4e-5)
    assert certain.mean() > 0.95
    np.testing.assert_array_equal(labels[certain], rendered.argmax(axis=-1)[certain])
    image = noise(*shape, 3)
    views = representation.whole().render(image, "bilinear")
    sure = certain_pixels(Case(reference.dim, shape), "bilinear")
    np.testing.assert_allclose(views[sure], reference.forward(image)[sure], atol=1e-9)


def test_training_samples_are_all_faces_turned_and_mirrored() -> None:
    image = noise(32, 64)
    plain = CubemapRepresentation(4).sample(np.random.default_rng(0)).render(image, "bilinear")
    np.testing.assert_array_equal(plain, equirect_to_tangent(image, CubeGrid(16)))
    angle = np.random.default_rng(0).uniform(0, 2 * np.pi)
    turned = CubeGrid(16, rotation_about((0, 0, 1), angle))
    views = CubemapRepresentation(4, rotation="yaw").sample(np.random.default_rng(0))
    np.testing.assert_array_equal(
        views.render(image, "bilinear"), equirect_to_tangent(image, turned)
    )
    mirrored = 0
    for seed in range(40):
        sampled = CubemapRepresentation(4, mirror=True).sample(np.random.default_rng(seed))
        found = sampled.render(image, "bilinear")
        flipped = np.array_equal(found, plain[:, :, ::-1])
        assert flipped or np.array_equal(found, plain)
        mirrored += flipped
    assert 10 < mirrored < 30
