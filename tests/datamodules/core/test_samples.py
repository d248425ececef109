from __future__ import annotations

import colorsys
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from datamodules.core.dataset import (
    Image,
    ImageDataset,
    jitter_colors,
    render_inputs,
    sample_rng,
)
from datamodules.core.inputs import RGB_NORMALIZATION, RGBD_NORMALIZATION, Input, normalize
from tangent_train.geometry import equirect_directions
from tangent_train.rendering import (
    CubemapRepresentation,
    EquirectRepresentation,
    HorizontalRepresentation,
    TangentRepresentation,
)
from tangent_train.rendering.representations.views import Representation

DEPTH: tuple[Input, ...] = ("rgb", "depth")


def _positions(index: int) -> Image:
    """A panorama whose every pixel has its own red, depth and label."""
    place = np.arange(16 * 32).reshape(16, 32) % 251
    labels = (place + index).astype(np.uint8)
    return Image(np.stack([labels] * 3, axis=-1), labels.astype(np.uint16) * 4, labels)


class _Positions(ImageDataset):
    """Three panoramas in memory."""

    def read(self, index: int) -> Image:
        return _positions(index)


# --- normalization -----------------------------------------------------------------------------


@pytest.mark.parametrize("depth", [True, False])
def test_normalize_against_the_formula(depth: bool) -> None:
    rng = np.random.default_rng(0)
    rgb = rng.integers(0, 256, (3, 2, 4, 5, 3), np.uint8)
    steps = rng.integers(0, 2049, (3, 2, 4, 5)).astype(np.int16)
    inputs = [torch.from_numpy(array) for array in ((rgb, steps) if depth else (rgb,))]
    normalization = RGBD_NORMALIZATION if depth else RGB_NORMALIZATION
    images = normalize(inputs, normalization, DEPTH if depth else ("rgb",))
    assert images.shape == (3, 2, 4 if depth else 3, 4, 5)
    assert images.dtype == torch.float32
    assert images.is_contiguous()
    for channel, (mean, std) in enumerate(zip(normalization.mean, normalization.std, strict=True)):
        value = rgb[..., channel] / 255 if channel < 3 else steps / 512
        np.testing.assert_allclose(images[:, :, channel], (value - mean) / std, atol=1e-5)


# --- other inputs -------------------------------------------------------------------------------


@pytest.mark.parametrize("up", [None, (0.6, 0.0, 0.8)])
@pytest.mark.parametrize(
    "representation",
    [
        TangentRepresentation(0, 5, random_rotation="so3", faces_per_panorama=4, mirror=True),
        EquirectRepresentation(5, crop_deg=90, random_rotation="yaw", mirror=True),
    ],
)
def test_elevation_is_how_far_a_pixel_looks_up(
    representation: Representation, up: tuple[float, float, float] | None
) -> None:
    """Against directions rendered as three pictures: the same pixels, another way to the angle."""
    shape = (64, 128)
    zenith = None if up is None else np.array(up)
    image = Image(np.zeros((*shape, 3), np.uint8), None, np.zeros(shape, np.uint8), zenith)
    for seed in range(4):
        views = representation.sample(np.random.default_rng(seed))
        elevation = render_inputs(image, views, ("rgb", "elevation"))[1].numpy()
        directions = views.render(equirect_directions(shape).astype(np.float32), "bilinear")
        expected = directions @ np.array((0, 0, 1) if up is None else up)
        np.testing.assert_allclose(elevation, expected, atol=1e-5)
        assert elevation.dtype == np.float32


# --- samples -----------------------------------------------------------------------------------


def _training(erp: Representation, seed: int = 0, color_jitter: float = 0) -> ImageDataset:
    settings = {"seed": seed, "sampling_seed": 0, "color_jitter": color_jitter, "inputs": DEPTH}
    files: Any = {"train": [None] * 3}
    data = SimpleNamespace(
        **settings, representation=erp, in_memory=False, splits=lambda: files, cache=None
    )
    return _Positions(data, "train")


def test_a_training_sample_holds_the_rendered_views(erp: Representation) -> None:
    sample = _training(erp)[4, 1]
    rgb, depth = sample.images
    assert (rgb.shape, rgb.dtype) == ((1, 16, 8, 3), torch.uint8)
    assert (depth.shape, depth.dtype) == ((1, 16, 8), torch.int16)
    assert (sample.labels.shape, sample.labels.dtype) == ((1, 16, 8), torch.uint8)
    assert sample.index == 1
    # The same pixels in all channels; neither depth nor labels are interpolated.
    for channel in range(3):
        torch.testing.assert_close(rgb[..., channel], sample.labels)
    sample = _training(TangentRepresentation(0, 3, random_rotation="so3"))[0, 0]
    torch.testing.assert_close(sample.images[1], sample.labels.short() * 4)
    assert not torch.equal(sample.images[0][..., 0], sample.labels), "colors are interpolated"


def test_views_are_those_of_seed_epoch_and_index(erp: Representation) -> None:
    first = _training(erp)[4, 1].labels
    assert torch.equal(first, _training(erp)[4, 1].labels)
    assert not torch.equal(first, _training(erp)[5, 1].labels)
    assert not torch.equal(first, _training(erp, seed=1)[4, 1].labels)


def _cells(image: NDArray[Any], rays: NDArray[Any], dim: int, parts: int) -> NDArray[np.float64]:
    """Nearest pixels at parts × parts positions in each pixel of views, in float64."""
    places = (2 * np.arange(parts * dim) + 1) / (parts * dim) - 1
    plane = np.stack([*np.meshgrid(places, places), np.ones((parts * dim,) * 2)], -1)
    x, y, z = np.einsum("nij,hwj->inhw", rays.astype(np.float64), plane)
    height, width = image.shape[:2]
    column = np.floor((np.arctan2(y, x) / (2 * np.pi) + 0.5) * width).astype(int) % width
    row = np.floor((0.5 - np.arctan2(z, np.hypot(x, y)) / np.pi) * height).astype(int)
    cells = image[row.clip(0, height - 1), column].astype(np.float64)
    return cells.reshape(len(rays), dim, parts, dim, parts, *image.shape[2:])


@pytest.mark.parametrize(
    "representation",
    [
        CubemapRepresentation(4, dim=16, random_rotation="so3", mirror=True),
        TangentRepresentation(0, 4, random_rotation="so3", faces_per_panorama=8, mirror=True),
        HorizontalRepresentation(4, [{"pitch": 0, "views": 6}], 130, 24, blend="nearest",
                                 area=(-180, 180, -40, 40), random_rotation="yaw"),
    ],
)  # fmt: skip
def test_views_much_coarser_than_the_panorama_average_colors_and_copy_labels_and_depth(
    representation: Representation,
) -> None:
    """White noise: means have a small deviation, and copied pixels are those of the panorama."""
    rng, shape = np.random.default_rng(0), (256, 512)
    rgb = (rng.integers(0, 2, (*shape, 3)) * 255).astype(np.uint8)
    depth = rng.integers(1, 2000, shape).astype(np.uint16)
    image = Image(rgb, depth, rng.integers(0, 256, shape).astype(np.uint8))
    data = _training(representation)
    data.read = lambda index: image  # type: ignore[method-assign]
    for epoch in range(3):
        sample = data[epoch, 0]
        views: Any = representation.sample(sample_rng((0, 0), epoch, 0))
        colors, steps = sample.images
        dim = colors.shape[1]
        means = _cells(rgb, views.rays(), dim, 25).mean(axis=(2, 4))
        assert colors.double().std() < 1.1 * means.std()
        assert ((colors.numpy() - means) ** 2).mean() < means.var()  # not reduced: 9 times as much
        for found, whole in ((steps, depth), (sample.labels, image.labels)):
            exact = _cells(whole, views.rays(), dim, 1)[:, :, 0, :, 0]
            assert (found.numpy() == exact).mean() > 0.995  # others are at edges of pixels


# --- colors -----------------------------------------------------------------------------------


def test_jitter_changes_the_colors_and_nothing_else(erp: Representation) -> None:
    before = _training(erp)[2, 1]
    after, again = (_training(erp, color_jitter=0.5)[2, 1] for _ in range(2))
    assert not torch.equal(before.images[0], after.images[0])
    assert torch.equal(before.images[1], after.images[1])
    assert torch.equal(before.labels, after.labels)
    assert torch.equal(after.images[0], again.images[0])


def test_jitter_against_slow_formulas() -> None:
    strength = 0.4
    rgb = np.random.default_rng(1).integers(40, 160, (2, 3, 5, 3), np.uint8)
    found = jitter_colors(torch.from_numpy(rgb), strength, np.random.default_rng(7)).numpy()
    rng = np.random.default_rng(7)
    brightness, contrast, saturation = (rng.uniform(1 - strength, 1 + strength) for _ in range(3))
    hue = rng.uniform(-1, 1) * strength / 10

    def gray(colors: NDArray[np.floating]) -> NDArray[np.floating]:
        return colors @ [0.2989, 0.587, 0.114]

    colors = np.minimum(rgb / 255 * brightness, 1)
    colors = np.clip(contrast * colors + (1 - contrast) * gray(colors).mean(), 0, 1)
    colors = np.clip(saturation * colors + (1 - saturation) * gray(colors)[..., None], 0, 1)
    for place in np.ndindex(rgb.shape[:3]):
        h, s, v = colorsys.rgb_to_hsv(*colors[place])
        expected = colorsys.hsv_to_rgb((h + hue) % 1, s, v)
        np.testing.assert_allclose(found[place] / 255, expected, atol=4 / 255)
