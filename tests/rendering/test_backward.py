"""Render tangent images back to panoramas."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from tangent_train.errors import SettingError
from tangent_train.geometry import TangentGrid
from tangent_train.rendering import equirect_to_tangent, tangent_to_equirect, tangent_to_labels

BLENDS: list[Any] = ["nearest", "feather"]


@pytest.mark.parametrize("value", [np.int32(2**24 + 1), np.uint32(2**32 - 1), np.float64(1 / 3)])
@pytest.mark.parametrize("blend", BLENDS)
def test_arrays_that_float32_cannot_hold_are_exact(blend: Any, value: Any) -> None:
    images = np.full((20, 32, 32), value)
    panorama = tangent_to_equirect(images, TangentGrid(0, 5), (32, 64), blend)
    assert panorama.dtype == value.dtype
    np.testing.assert_allclose(panorama, value, rtol=1e-12)


@pytest.mark.parametrize(("base_level", "shape"), [(0, (31, 63)), (1, (32, 64)), (3, (31, 63))])
def test_one_class_covers_the_whole_panorama(base_level: int, shape: tuple[int, int]) -> None:
    """There are no other values at the poles, at the seam, or between images."""
    grid = TangentGrid(base_level, base_level + 4)
    panorama = np.full(shape, 3, np.uint8)
    for interpolation in ("nearest", "bilinear"):
        images = equirect_to_tangent(panorama, grid, interpolation=interpolation)
        assert (images == 3).all()
    scores = np.eye(5, dtype=np.float32)[images].transpose(0, 3, 1, 2)
    for blend in ("nearest", "feather"):
        assert (tangent_to_labels(scores, grid, shape, blend) == 3).all()


@pytest.mark.parametrize("blend", BLENDS)
def test_equal_infinite_and_nan_scores_have_defined_labels(blend: Any) -> None:
    grid = TangentGrid(0, 4)
    scores = np.zeros((20, 18, 16, 16), np.float32)
    assert not tangent_to_labels(scores, grid, (16, 32), blend).any()
    scores[:, 0] = -0.0
    assert not tangent_to_labels(scores, grid, (16, 32), blend).any()
    scores[:, 0] = -np.inf
    assert (tangent_to_labels(scores, grid, (16, 32), blend) == 1).all()
    scores[0] = np.nan
    labels = tangent_to_labels(scores, grid, (16, 32), blend)
    assert labels.dtype == np.uint8
    assert set(np.unique(labels)) <= {1, 18}
    scores[:] = np.nan
    assert (tangent_to_labels(scores, grid, (16, 32), blend) == 18).all()


@pytest.mark.parametrize(
    ("num_classes", "shape"), [(1, (9, 20)), (15, (70, 141)), (40, (9, 20)), (257, (70, 141))]
)
def test_every_number_of_classes_works(num_classes: int, shape: tuple[int, int]) -> None:
    """The compiled kernel pads to 16; images may be finer or coarser than the panorama."""
    grid = TangentGrid(0, 4)
    size = (grid.num_images, num_classes, grid.dim, grid.dim)
    scores = np.random.default_rng(0).standard_normal(size, np.float32)
    exact = tangent_to_equirect(torch.from_numpy(scores).double(), grid, shape).argmax(dim=0)
    labels = tangent_to_labels(scores, grid, shape)
    assert labels.dtype == (np.uint8 if num_classes < 256 else np.uint16)
    assert (labels == exact.numpy()).mean() > 0.999


@pytest.mark.parametrize("dtype", [np.uint8, np.int32, np.float32])
@pytest.mark.parametrize("channels", [(), (2,)])
@pytest.mark.parametrize(
    "way", [{"blend": "nearest"}, {"blend": "feather"}, {"interpolation": "nearest"}]
)
def test_arrays_agree_with_tensors(dtype: Any, channels: tuple[int, ...], way: Any) -> None:
    grid = TangentGrid(0, 4)
    images = (np.random.default_rng(0).random((20, 16, 16, *channels)) * 250).astype(dtype)
    images.setflags(write=False)
    tensor = torch.from_numpy(images.astype(np.float64).reshape(20, 16, 16, -1)).movedim(-1, 1)
    expected = tangent_to_equirect(tensor, grid, (15, 32), **way).movedim(0, -1).numpy()
    found = tangent_to_equirect(images, grid, (15, 32), **way)
    assert (found.dtype, found.shape) == (dtype, (15, 32, *channels))
    tolerance = 0.501 if np.dtype(dtype).kind in "ui" else 2e-4
    tolerance = 0 if "interpolation" in way else tolerance
    np.testing.assert_allclose(found.reshape(expected.shape), expected, rtol=0, atol=tolerance)


def test_batches_and_dtypes_are_kept() -> None:
    grid = TangentGrid(0, 4)
    images = torch.rand(2, 3, 20, 4, 16, 16)
    panorama = tangent_to_equirect(images, grid, (16, 32))
    assert panorama.shape == (2, 3, 4, 16, 32)
    torch.testing.assert_close(panorama[1, 2], tangent_to_equirect(images[1, 2], grid, (16, 32)))
    half = tangent_to_equirect(images.bfloat16(), grid, (16, 32))
    assert half.dtype == torch.bfloat16
    assert tangent_to_labels(images[:0], grid, (16, 32)).shape == (0, 3, 16, 32)


@pytest.mark.parametrize("blend", BLENDS)
def test_gradients_agree_with_finite_differences(blend: Any) -> None:
    grid = TangentGrid(0, 3)
    images = torch.rand(20, 1, 8, 8, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(
        lambda x: tangent_to_equirect(x, grid, (5, 9), blend), images, fast_mode=True
    )


@pytest.mark.parametrize(
    ("images", "shape", "blend", "message"),
    [
        (torch.zeros(19, 1, 16, 16), (8, 16), "nearest", r"expected \(..., 20, channels, 16, 16\)"),
        (torch.zeros(20, 1, 16, 16, dtype=torch.int64), (8, 16), "nearest", "int64"),
        (torch.zeros(20, 1, 16, 16), (8, 16), "linear", "blend"),
    ],
)
@pytest.mark.parametrize("render", [tangent_to_equirect, tangent_to_labels])
def test_unusable_arguments_are_refused(
    render: Any, images: Any, shape: Any, blend: Any, message: str
) -> None:
    with pytest.raises(SettingError, match=message):
        render(images, TangentGrid(0, 4), shape, blend)
