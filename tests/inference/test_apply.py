"""Functions of images applied to panoramas agree with rendering forth and back."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from tangent_train.errors import SettingError
from tangent_train.geometry import TangentGrid, equirect_directions, rotation_about
from tangent_train.inference.api import apply
from tangent_train.rendering import Blend, equirect_to_tangent, tangent_to_equirect

TURNED = TangentGrid(0, 5, rotation=rotation_about((1, 2, 3), 1.0))
Function = Callable[[Any], Any]


def _smooth(height: int) -> NDArray[np.float32]:
    return equirect_directions((height, 2 * height)).astype(np.float32)


def _features(images: NDArray[np.float32]) -> NDArray[np.float64]:
    """Five features of every pixel and its neighbors."""
    blurred = (images + np.roll(images, 1, axis=2)) / 2
    return np.concatenate([blurred, np.sin(3 * images[..., :2])], axis=-1).astype(np.float64)


@pytest.mark.parametrize(
    ("grid", "blend", "images_per_call"),
    [
        (TangentGrid(0, 5), "nearest", 1),
        (TURNED, "feather", 7),
        (TangentGrid(2, 5), "nearest", None),
    ],
)
def test_results_are_those_of_all_images_at_once(
    grid: TangentGrid, blend: Blend, images_per_call: int | None
) -> None:
    panorama = _smooth(33)
    found = apply(_features, panorama, grid, blend, images_per_call=images_per_call)
    images = _features(equirect_to_tangent(panorama, grid))
    expected = tangent_to_equirect(images, grid, (33, 66), blend)
    assert found.dtype == np.float32
    assert found.shape == (33, 66, 5)
    np.testing.assert_allclose(found, expected, atol=1e-5)


@pytest.mark.parametrize(
    ("grid", "images_per_call", "expected"),
    [(TangentGrid(1, 5), 32, [32, 32, 16]), (TangentGrid(0, 9), None, [4] * 5)],  # 4 · 512² = 2^20
)
def test_images_are_passed_in_order_and_in_limited_number(
    grid: TangentGrid, images_per_call: int | None, expected: list[int]
) -> None:
    counts, seen = [], []

    def noted(images: NDArray[np.uint8]) -> NDArray[np.float32]:
        counts.append(len(images))
        seen.append(images)
        return np.zeros(images.shape[:3], np.float32)

    panorama = np.random.default_rng(0).integers(0, 256, (64, 128, 3), np.uint8)
    apply(noted, panorama, grid, images_per_call=images_per_call)
    assert counts == expected
    np.testing.assert_array_equal(np.concatenate(seen), equirect_to_tangent(panorama, grid))


@pytest.mark.parametrize("dtype", [np.int64, bool])
@pytest.mark.parametrize("channels", [(), (2,)])
def test_labels_and_masks_are_copied_from_the_owner(dtype: Any, channels: tuple[int, ...]) -> None:
    grid, panorama = TangentGrid(1, 5), _smooth(33)

    def labels(images: NDArray[np.float32]) -> NDArray[Any]:
        kept = images[..., 0] if not channels else images[..., :2]
        return (kept > 0.2).astype(dtype)

    found = apply(labels, panorama, grid, "nearest", images_per_call=9)
    images = labels(equirect_to_tangent(panorama, grid))
    expected = tangent_to_equirect(images, grid, (33, 66), interpolation="nearest")
    assert (found.dtype, found.shape) == (np.dtype(dtype), (33, 66, *channels))
    np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("blend", ["nearest", "feather"])
def test_tensors_and_arrays_agree(blend: Blend) -> None:
    grid, panorama = TangentGrid(0, 5), _smooth(32)
    tensor = torch.from_numpy(panorama).movedim(-1, 0).requires_grad_()
    expected = apply(lambda images: images[..., :2] ** 2, panorama, grid, blend)
    found = apply(lambda images: images[:, :2] ** 2, tensor, grid, blend)
    assert isinstance(found, torch.Tensor)
    assert found.shape == (2, 32, 64)
    np.testing.assert_allclose(found.movedim(0, -1).numpy(), expected, atol=1e-5)
    depth = apply(lambda images: images[:, 0].bfloat16(), tensor, grid, blend)
    assert (depth.dtype, depth.shape) == (torch.float32, (32, 64))
    np.testing.assert_allclose(depth.numpy(), panorama[..., 0], atol=0.05)


_ARRAY = np.zeros((8, 16, 3), np.float32)


@pytest.mark.parametrize(
    ("function", "message"),
    [
        (lambda images: images[1:], "expected numbers for 10 images of 16×16 pixels, as ndarray"),
        (lambda images: images.astype(complex), "complex128; expected numbers"),
        (torch.from_numpy, "found Tensor"),
    ],
)
def test_other_results_are_refused(function: Function, message: str) -> None:
    with pytest.raises(SettingError, match=message):
        apply(function, _ARRAY, TangentGrid(0, 4), images_per_call=10)
