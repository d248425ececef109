"""Rendering against the slow reference written from the paper (`tests.rendering.reference`)."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from tangent_train.errors import SettingError
from tangent_train.geometry import PinholeGrid, RingGrid, TangentGrid, rotation_about
from tangent_train.rendering import (
    Blend,
    Interpolation,
    equirect_to_tangent,
    rotate_equirect,
    tangent_to_equirect,
    tangent_to_labels,
)
from tests.rendering.reference import (
    Array,
    ReferenceGrid,
    certain_labels,
    certain_nearest,
    panorama_lonlat,
    sample_panorama,
    to_lonlat,
    to_xyz,
)

CLASSES = 5
POSITION_ERROR = 0.0 if int(cv2.__version__.split(".")[0]) >= 5 else 1 / 64
"""OpenCV 4 rounds positions to 1/32 px, up to 1/64 px off each way; OpenCV 5 does not."""
ROTATION = rotation_about((1, -2, 0.5), 2.3)


class Case(NamedTuple):
    """A set of tangent images and a panorama size, not the level's own, that is not reduced."""

    base_level: int
    level: int
    dim: int | None
    shape: tuple[int, int]
    rotated: bool = False


class RingCase(NamedTuple):
    """A set of horizontal views, by pitch and number, and a panorama size."""

    rings: tuple[tuple[float, int], ...]
    size: tuple[int, int]
    fov_deg: tuple[float, float]
    shape: tuple[int, int]
    rotated: bool = False


CASES = [
    Case(0, 4, None, (36, 72)),  # the paper's extent
    Case(0, 5, 24, (63, 126)),  # cropped to the least; odd rows: one on the equator
    Case(0, 3, 12, (17, 35), rotated=True),  # a margin; half a revolution is not a whole column
    Case(1, 4, None, (36, 72), rotated=True),
    Case(1, 5, 13, (63, 126)),
    Case(2, 5, None, (32, 64)),
    RingCase(((0, 8), (40, 5), (-40, 5)), (16, 16), (100, 100), (33, 66)),
    RingCase(((0, 7), (55, 4), (-55, 4)), (20, 15), (70, 90), (33, 67), rotated=True),
    RingCase(((90, 1), (25, 5), (-35, 3)), (16, 25), (130, 110), (26, 53)),
]


class Pair(NamedTuple):
    """A grid, its reference, and the face of the reference for each face of the grid."""

    grid: PinholeGrid
    reference: ReferenceGrid
    order: NDArray[np.int64]


@pytest.fixture(params=CASES, ids=str)
def case(request: pytest.FixtureRequest) -> Case | RingCase:
    assert isinstance(request.param, Case | RingCase)
    return request.param


@lru_cache
def pair_of(case: Case | RingCase) -> Pair:
    rotation, of_grid = (ROTATION, ROTATION) if case.rotated else (np.eye(3), None)
    grid: PinholeGrid
    if isinstance(case, RingCase):
        rings = [{"pitch": pitch, "views": views} for pitch, views in case.rings]
        grid = RingGrid(rings, case.fov_deg, case.size, of_grid, by_owners=True)
        across, down = (math.tan(math.radians(angle / 2)) for angle in case.fov_deg)
        pitch = max(2 * down / case.size[0], 2 * across / case.size[1])
        centers = [
            (k * 2 * math.pi / n, math.radians(lat)) for lat, n in case.rings for k in range(n)
        ]
        reference = ReferenceGrid(np.array(centers), pitch, case.size, rotation)
    else:
        grid = TangentGrid(case.base_level, case.level, case.dim, of_grid)
        reference = ReferenceGrid.tangent(case.base_level, case.level, grid.dim, rotation)
    return Pair(grid, reference, reference.order(grid.centers_xyz))


def noise(*shape: int, seed: int = 0) -> Array:
    """White noise from 0 to 1, which reveals each pixel from a wrong position."""
    return np.random.default_rng(seed).random(shape)


def waves(shape: tuple[int, int]) -> Array:
    """A panorama ``(H, W, 3)`` from 0 to 1, smooth also across the seam and the poles."""
    x, y, z = np.moveaxis(to_xyz(panorama_lonlat(shape)), -1, 0)
    channels = [np.sin(4 * x + y), np.cos(3 * y - 2 * z), np.sin(5 * z + 2 * x * y)]
    return np.asarray((np.stack(channels, axis=-1) + 1) / 2)


def certain_pixels(
    pair: Pair, case: Case | RingCase, interpolation: Interpolation
) -> NDArray[np.bool_]:
    """Pixels ``(n, d, d)`` of the grid's images that do not depend on rounding."""
    if interpolation == "bilinear":
        return np.ones((len(pair.order), *pair.grid.size), bool)
    lonlat = np.stack([pair.reference.lonlat(face) for face in pair.order])
    # Nearest takes a pixel of an image smaller than 2^7: float32 rounds positions to 2^-17.
    certain = certain_nearest(lonlat, case.shape, margin=1e-4)
    assert certain.mean() > 0.9
    return certain


@pytest.mark.parametrize("interpolation", ["bilinear", "nearest"])
def test_tensors_are_rendered_like_the_reference(
    case: Case | RingCase, interpolation: Interpolation
) -> None:
    pair = pair_of(case)
    image = noise(*case.shape, 3)
    expected = pair.reference.forward(image, interpolation)[pair.order]
    certain = certain_pixels(pair, case, interpolation)
    for dtype, tolerance in ((torch.float64, 1e-9), (torch.float32, 2e-4)):
        tensor = torch.from_numpy(image).permute(2, 0, 1).to(dtype)
        result = equirect_to_tangent(tensor, pair.grid, interpolation=interpolation)
        assert result.dtype == dtype
        assert result.shape == (len(pair.order), 3, *pair.grid.size)
        error = np.abs(result.permute(0, 2, 3, 1).double().numpy() - expected)
        assert error[certain].max() < tolerance


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_forward_of_labels_is_the_nearest_label(
    case: Case | RingCase, dtype: type[np.integer]
) -> None:
    pair = pair_of(case)
    labels = (noise(*case.shape) * np.iinfo(dtype).max).astype(dtype)
    certain = certain_pixels(pair, case, "nearest")
    expected = pair.reference.forward(labels[..., None].astype(np.float64), "nearest")[pair.order]
    result = equirect_to_tangent(labels, pair.grid, interpolation="nearest")
    assert result.dtype == dtype
    assert result.shape == expected.shape[:-1]
    np.testing.assert_array_equal(result[certain], expected[..., 0][certain])


@pytest.mark.parametrize("channels", [0, 1, 3, 6])  # 0: an image (H, W)
@pytest.mark.parametrize(
    ("dtype", "largest", "tolerance"),
    [
        ("uint8", 255, 0.501),
        ("uint16", 65535, 1.0),
        ("int32", 2**16, 0.55),
        ("float32", 1, 2e-4),
        ("float64", 1, 1e-9),
    ],
)
def test_every_number_of_channels_is_rendered(
    channels: int, dtype: str, largest: int, tolerance: float
) -> None:
    pair = pair_of(CASES[0])
    shape = (36, 72, channels) if channels else (36, 72)
    smooth = np.take(waves((36, 72)), np.arange(max(1, channels)) % 3, axis=-1)
    image = (largest * smooth.reshape(shape)).astype(dtype)
    exact = image.reshape(36, 72, -1).astype(np.float64)
    # OpenCV rounds positions; float32 positions near 100 are good to 4e-6 px.
    steps = [np.abs(np.diff(exact, axis=axis)).max() for axis in (0, 1)]
    tolerance += (dtype not in ("int32", "float64")) * 2 * POSITION_ERROR * sum(steps)
    expected = pair.reference.forward(exact)[pair.order].reshape(20, 16, 16, *shape[2:])
    result = equirect_to_tangent(image, pair.grid)
    assert (result.dtype.name, result.shape) == (dtype, expected.shape)
    assert np.abs(result - expected).max() < tolerance
    assert abs((result - expected).mean()) < 0.1 or largest > 255, "no bias"


@pytest.mark.parametrize("interpolation", ["bilinear", "nearest"])
@pytest.mark.parametrize("shape", [(50, 100), (33, 67)])
def test_rotated_panoramas_agree_with_the_reference(
    shape: tuple[int, int], interpolation: Interpolation
) -> None:
    image = noise(*shape, 3)
    seen_from = to_lonlat(to_xyz(panorama_lonlat(shape)) @ ROTATION)  # R⁻¹ d
    expected = sample_panorama(image, seen_from, interpolation)
    certain = certain_nearest(seen_from, shape, margin=1e-4) | (interpolation == "bilinear")
    error = np.abs(rotate_equirect(image, ROTATION, interpolation) - expected)
    assert error[certain].max() < 1e-9
    with pytest.raises(SettingError, match="rotation"):
        rotate_equirect(image, -ROTATION, interpolation)


def rendered_back(pair: Pair, images: Array, shape: tuple[int, int], blend: Blend) -> Array:
    """The reference's panorama of the grid's images ``(n, d, d, C)``."""
    in_their_order = np.empty_like(images)
    in_their_order[pair.order] = images
    if blend == "feather":
        return pair.reference.feathered(in_their_order, shape)
    return pair.reference.backward(in_their_order, shape)


def clear_pixels(pair: Pair, shape: tuple[int, int], blend: Blend) -> NDArray[np.bool_]:
    """Panorama pixels whose owner does not depend on rounding; a feathered one has no owner."""
    clear = pair.reference.clear(shape) if blend == "nearest" else np.ones(shape, bool)
    assert clear.mean() > 0.95
    return clear


@pytest.mark.parametrize("blend", ["nearest", "feather"])
def test_tensors_are_rendered_back_like_the_reference(case: Case | RingCase, blend: Blend) -> None:
    pair = pair_of(case)
    images = noise(len(pair.order), *pair.grid.size, 3)
    clear = clear_pixels(pair, case.shape, blend)
    expected = rendered_back(pair, images, case.shape, blend)[clear]
    for dtype, tolerance in ((torch.float64, 1e-9), (torch.float32, 2e-5)):
        tensor = torch.from_numpy(images).permute(0, 3, 1, 2).to(dtype)
        result = tangent_to_equirect(tensor, pair.grid, case.shape, blend)
        assert (result.dtype, result.shape) == (dtype, (3, *case.shape))
        error = result.permute(1, 2, 0).double().numpy()[clear] - expected
        assert np.abs(error).max() < tolerance
    arrays = tangent_to_equirect(images.astype(np.float32), pair.grid, case.shape, blend)
    np.testing.assert_allclose(arrays[clear], expected, atol=2e-5)


def test_nearest_is_the_nearest_pixel(case: Case | RingCase) -> None:
    grid, reference, order = pair_of(case)
    owner = reference.nearness(case.shape).argmax(axis=-1)
    places = np.stack(reference.positions(case.shape, owner))
    # Half-way between two pixels or two images, rounding decides.
    certain = reference.clear(case.shape) & (np.abs(places % 1 - 0.5) > 1e-4).all(axis=0)
    assert certain.mean() > 0.9
    # Every pixel has a value of its own.
    images = np.arange(grid.num_images * math.prod(grid.size)).reshape(-1, *grid.size)
    last = np.array(grid.size)[:, None, None] - 1
    row, column = np.floor(places + 0.5).clip(0, last).astype(int)
    expected = images[np.argsort(order)[owner], row, column]
    found = tangent_to_equirect(images, grid, case.shape, interpolation="nearest")
    assert found.dtype == images.dtype
    np.testing.assert_array_equal(found[certain], expected[certain])


@pytest.mark.parametrize("blend", ["nearest", "feather"])
def test_labels_are_the_best_interpolated_logits(case: Case | RingCase, blend: Blend) -> None:
    pair = pair_of(case)
    logits = noise(len(pair.order), *pair.grid.size, CLASSES)
    rendered = rendered_back(pair, logits, case.shape, blend)
    clear = clear_pixels(pair, case.shape, blend)
    tensor = torch.from_numpy(logits).permute(0, 3, 1, 2)
    labels = tangent_to_labels(tensor, pair.grid, case.shape, blend).numpy()
    certain = clear & certain_labels(rendered, margin=4e-5)
    assert certain.mean() > 0.95
    np.testing.assert_array_equal(labels[certain], rendered.argmax(axis=-1)[certain])
