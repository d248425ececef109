"""Render panoramas to tangent images."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from tangent_train.errors import SettingError
from tangent_train.geometry import (
    CubeGrid,
    PinholeGrid,
    RingGrid,
    TangentGrid,
    equirect_shape,
    random_rotation,
    xyz_to_lonlat,
)
from tangent_train.rendering import (
    equirect_to_tangent,
    forward,
    perspective,
    tables,
    tangent_to_equirect,
)
from tangent_train.rendering.resampling import reduce_to_pitch, resize
from tests.rendering.reference import sample_panorama

Array = NDArray[Any]
TURNED = TangentGrid(0, 5, rotation=random_rotation(np.random.default_rng(1)))


def _random(shape: tuple[int, ...], dtype: Any = np.float64) -> Array:
    values = np.random.default_rng(0).random(shape)
    return (values * 250).astype(dtype) if np.dtype(dtype).kind in "ui" else values.astype(dtype)


def _sampled(image: Array, u: Any, v: Any, interpolation: Any = "bilinear") -> Array:
    u, v = (np.atleast_2d(np.asarray(line, np.float32)) for line in (u, v))
    out = np.empty((*u.shape, *image.shape[2:]), image.dtype)
    table = tables.EquirectMap.of(u, v, (image.shape[0], image.shape[1]))
    forward.sample_map(table, image, interpolation, out)
    return out


@pytest.mark.parametrize("dtype", [np.uint8, np.float32])
@pytest.mark.parametrize("shape", [(1, 2), (5, 11), (64, 128), (3, 32768), (2, 40001)])
def test_colors_equal_exact_values_everywhere(shape: tuple[int, int], dtype: Any) -> None:
    height, width = shape
    image = _random((*shape, 3), dtype)
    image.flags.writeable = False
    rng = np.random.default_rng(0)
    u = rng.uniform(-0.5, width - 0.5, (50, 40))
    v = rng.uniform(-0.5, height - 0.5, (50, 40))
    u[:2] = np.resize([-0.5, 0, width - 1, width - 0.5], 40)
    v[:2] = np.resize([-0.5, 0, 0.25, height - 1, height - 0.5], 40)
    error = _sampled(image, u, v) - _sampled(image.astype(np.float64), u, v)
    assert np.abs(error).max() <= (0.5 + 1e-4 if dtype == np.uint8 else 1e-5)


@pytest.mark.parametrize(
    ("dtype", "channels"),
    [(np.uint16, ()), (np.uint8, (3,)), (np.float32, (4,)), (np.uint8, (6,))],
)
@pytest.mark.parametrize("left", [31.0, 57.5, 62.5, -0.5])
@pytest.mark.parametrize("top", [-0.5, 7.0, 22.5])
def test_parts_of_panoramas_are_found_across_seam_and_poles(
    top: float, left: float, dtype: Any, channels: tuple[int, ...]
) -> None:
    """Ten pixels around, across the seam (63.5 or −0.5), up to a pole, half-way between pixels."""
    image = _random((32, 64, *channels), dtype)
    v, u = top + np.mgrid[0:9.125:0.125, 0:9.125:0.125]
    u = (u - top + left + 0.5) % 64 - 0.5
    error = _sampled(image, u, v).astype(np.float64) - _sampled(image.astype(np.float64), u, v)
    assert np.abs(error).max() <= (0.5 + 1e-3 if np.dtype(dtype).kind == "u" else 1e-4)
    row, column = v.round().astype(int).clip(0, 31), u.round().astype(int) % 64
    np.testing.assert_array_equal(_sampled(image, u, v, "nearest"), image[row, column])


@pytest.mark.parametrize("base_level", [0, 1])
def test_labels_at_the_seam_are_never_unknown(base_level: int) -> None:
    """In the paper's released code they were unknown."""
    grid = TangentGrid(base_level, base_level + 4)
    height, width = equirect_shape(grid.level)
    labels = np.full((height, width), 3, np.uint8)  # 0 would be unknown
    labels[:, 0], labels[:, -1] = 1, 2
    images = equirect_to_tangent(labels, grid, interpolation="nearest")
    assert images.min() > 0
    # The seam runs through images, its first column to the right of its last.
    lon = xyz_to_lonlat(grid.directions())[..., 0]
    step = 2 * np.pi / width
    np.testing.assert_array_equal(images == 1, lon < -np.pi + step)
    np.testing.assert_array_equal(images == 2, lon >= np.pi - step)
    assert (images == 1).any(axis=(1, 2)).sum() >= 4


@pytest.mark.parametrize("interpolation", ["bilinear", "nearest"])
@pytest.mark.parametrize("dtype", [np.uint8, np.float32])
def test_panoramas_too_large_for_opencv_are_rendered(
    monkeypatch: pytest.MonkeyPatch, interpolation: Any, dtype: Any
) -> None:
    image, grid = _random((32, 64, 3), dtype), TangentGrid(0, 4)
    expected = equirect_to_tangent(image, grid, interpolation=interpolation)
    monkeypatch.setattr(forward, "_REMAP_LIMIT", 8)
    monkeypatch.setattr("cv2.remap", None)
    found = equirect_to_tangent(image, grid, interpolation=interpolation)
    np.testing.assert_allclose(found, expected, atol=1 if dtype == np.uint8 else 1e-5)


@pytest.mark.parametrize("grid", [TangentGrid(0, 5), TURNED])
def test_only_the_requested_faces_are_rendered_in_order(
    grid: TangentGrid, monkeypatch: pytest.MonkeyPatch
) -> None:
    image = _random((64, 128, 6), np.uint8)
    monkeypatch.setattr("tangent_train.rendering.forward._TOGETHER", 7 * 32**2)
    whole = equirect_to_tangent(image, grid)
    for face in (0, 6, 7, 19):
        np.testing.assert_array_equal(equirect_to_tangent(image, grid, [face])[0], whole[face])
    np.testing.assert_array_equal(equirect_to_tangent(image, grid, [7, 2, 2]), whole[[7, 2, 2]])
    assert equirect_to_tangent(image, grid, []).shape == (0, 32, 32, 6)
    assert equirect_to_tangent(torch.rand(2, 3, 8, 16), grid, []).shape == (2, 0, 3, 32, 32)


def test_tensors_keep_batch_and_dtype() -> None:
    image, grid = torch.rand(2, 5, 3, 16, 32), TangentGrid(0, 4)
    images = equirect_to_tangent(image, grid)
    assert images.shape == (2, 5, 20, 3, 16, 16)
    half = equirect_to_tangent(image.half(), grid)
    assert half.dtype == torch.float16
    torch.testing.assert_close(half.float(), images, atol=2e-3, rtol=0)


@pytest.mark.parametrize("shape", [(6, 12), (5, 11)])
def test_gradients_agree_with_finite_differences(shape: tuple[int, int]) -> None:
    image = torch.rand(1, *shape, dtype=torch.float64, requires_grad=True)
    grid = TangentGrid(0, 3)
    assert torch.autograd.gradcheck(lambda x: equirect_to_tangent(x, grid, [0, 12]), image)


@pytest.mark.parametrize(
    ("image", "arguments", "message"),
    [
        (np.zeros((4, 8), complex), {"interpolation": "nearest"}, "complex"),
        (np.zeros((4, 8)), {"interpolation": "cubic"}, "interpolation: found 'cubic'"),
        (torch.zeros(1, 4, 8, dtype=torch.uint8), {}, "float"),
    ],
)
def test_unusable_arguments_are_refused(
    image: Any, arguments: dict[str, Any], message: str
) -> None:
    with pytest.raises(SettingError, match=message):
        equirect_to_tangent(image, TangentGrid(0, 4), **arguments)


def _area_means(image: Array, grid: PinholeGrid, parts: int) -> Array:
    """Means of the nearest pixels at parts × parts positions in each pixel, in float64."""
    height, width = image.shape[:2]
    sides = [(np.arange(parts * n) + 0.5) / parts - n / 2 for n in grid.size]
    y, x = np.meshgrid(*(side * grid.pitch for side in sides), indexing="ij")
    rays = np.einsum("nwc,ijc->nijw", grid.world_from_camera, np.stack([x, y, np.ones_like(x)], -1))
    longitude = np.arctan2(rays[..., 1], rays[..., 0])
    latitude = np.arctan2(rays[..., 2], np.hypot(rays[..., 0], rays[..., 1]))
    column = ((longitude / (2 * np.pi) + 0.5) * width).astype(int) % width
    row = ((0.5 - latitude / np.pi) * height).astype(int).clip(0, height - 1)
    cells = image[row, column].reshape(-1, grid.size[0], parts, grid.size[1], parts)
    return np.asarray(cells.mean(axis=(2, 4)))


COARSE = [
    RingGrid([{"pitch": 0, "views": 6}, {"pitch": 90, "views": 1}, {"pitch": -90, "views": 1}],
             (100, 100), (24, 24)),
    CubeGrid(16),
    TangentGrid(0, 4),
]  # fmt: skip


@pytest.mark.parametrize("dtype", [np.uint8, np.float32, np.int32])
@pytest.mark.parametrize("grid", COARSE)
def test_views_coarser_than_the_panorama_are_area_means(grid: PinholeGrid, dtype: Any) -> None:
    """White noise keeps the deviation of area means; stripes of one pixel become gray."""
    height = 256
    noise = np.random.default_rng(0).integers(0, 2, (height, 2 * height)) * 255.0
    stripes = np.tile([0.0, 255.0], (height, height))
    panorama = np.stack([noise, stripes], axis=-1).astype(dtype)
    images = equirect_to_tangent(panorama, grid)
    assert images.dtype == dtype
    means = _area_means(noise, grid, 2 * round(grid.pitch * height / np.pi) + 1)
    error = images[..., 0].astype(float) - means
    assert images[..., 0].std() < 1.1 * means.std()
    assert np.sqrt((error**2).mean()) < means.std()  # without reduction 3 to 5 times as much
    assert np.abs(images[..., 1].astype(float) - 127.5).max() < 20
    tensor = torch.from_numpy(panorama.astype(np.float64)).movedim(-1, 0).requires_grad_()
    rendered = equirect_to_tangent(tensor, grid)
    assert np.abs(rendered.movedim(1, -1).detach().numpy() - images).max() <= 1.5
    (gradient,) = torch.autograd.grad(rendered.sum(), tensor)
    assert gradient.sum() == pytest.approx(rendered.numel())
    labels = equirect_to_tangent(panorama, grid, interpolation="nearest")
    assert set(np.unique(labels)) == {0, 255}


@pytest.mark.parametrize("grid", [TangentGrid(0, 5), TangentGrid(2, 5), CubeGrid(32)])
def test_views_of_the_level_use_the_panorama_itself(grid: PinholeGrid) -> None:
    panorama = _random(equirect_shape(5))
    assert reduce_to_pitch(panorama, grid.pitch) is panorama


@pytest.mark.parametrize("channels", [(), (3,), (5,)])
def test_only_sides_that_become_smaller_are_averaged(channels: tuple[int, ...]) -> None:
    stripes = np.broadcast_to(np.arange(64) % 2 * 200.0, (8, 64)).astype(np.uint8)
    image = np.broadcast_to(stripes.reshape(8, 64, *(1 for _ in channels)), (8, 64, *channels))
    assert (resize(image, (16, 8), "bilinear") == 100).all()
    tensor = torch.from_numpy(stripes.astype(np.float32))[None].requires_grad_()
    assert torch.allclose(resize(tensor, (16, 8), "bilinear"), torch.tensor(100.0))


@pytest.mark.parametrize(
    ("yaw", "pitch", "roll"), [(0, 0, 0), (90, 60, 0), (-160, -85, 30), (20, 5, -135)]
)
def test_perspective_images_agree_with_the_textbook(yaw: float, pitch: float, roll: float) -> None:
    """Pixels are rotated clockwise, then up, then to the right; on a focal length of w/2/tan."""
    panorama = _random((32, 64, 3))
    x, y = np.meshgrid(np.arange(40) - 19.5, np.arange(30) - 14.5)
    a, b, c = np.radians([roll, pitch, yaw])
    right, up = x * np.cos(a) - y * np.sin(a), -x * np.sin(a) - y * np.cos(a)
    ahead = np.full_like(x, 20 / np.tan(np.radians(35)))
    forward, up = ahead * np.cos(b) - up * np.sin(b), ahead * np.sin(b) + up * np.cos(b)
    lonlat = np.stack(
        [np.arctan2(right, forward) + c, np.arctan2(up, np.hypot(right, forward))], -1
    )
    expected = sample_panorama(panorama, lonlat, "bilinear")
    found = perspective(panorama, yaw, pitch, 70, (40, 30), roll)
    np.testing.assert_allclose(found, expected, atol=1e-9)
    tensor = torch.from_numpy(panorama).movedim(-1, 0)
    images = perspective(tensor[None], [0, yaw], np.array([0, pitch]), 70, (40, 30), [0, roll])
    assert images.shape == (1, 2, 3, 30, 40)
    assert perspective(tensor[None][:0], [0, 9], size=8).shape == (0, 2, 3, 8, 8)
    np.testing.assert_allclose(images[0, 1].movedim(0, -1), expected, atol=1e-9)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"yaw": [1, 2], "pitch": [1, 2, 3]}, r"found \[1, 2\], \[1, 2, 3\], 0.0; expected finite"),
        ({"size": 0.5}, "size"),
        ({"fov": 180}, "fov"),
    ],
)
def test_perspective_images_that_do_not_exist_are_refused(given: Any, message: str) -> None:
    with pytest.raises(SettingError, match=message):
        perspective(np.ones((8, 16)), **given)


def test_tables_of_an_evaluation_serve_a_training() -> None:
    """Lightning evaluates in inference mode, whose tensors have no gradients."""
    grid = TangentGrid(0, 3)
    with torch.inference_mode():
        images = equirect_to_tangent(torch.rand(1, 14, 28).double(), grid)
        tangent_to_equirect(images, grid, (14, 28), "feather")
    panorama = torch.rand(1, 14, 28).double().requires_grad_()
    images = equirect_to_tangent(panorama, grid)
    total = tangent_to_equirect(images, grid, (14, 28), "feather").sum()
    assert torch.autograd.grad(total, panorama)[0].sum() == pytest.approx(14 * 28)
