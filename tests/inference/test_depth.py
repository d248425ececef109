"""Depth of panoramas and photos: true depth of views gives true depth of the whole."""

from __future__ import annotations

from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor, nn

import tangent_train as tt
from datamodules.core.inputs import Normalization
from tangent_train.checkpoints.loaded import LoadedNetwork
from tangent_train.config.build import build_from_config
from tangent_train.errors import SettingError
from tangent_train.geometry import (
    TangentGrid,
    camera_matrix_from_fov,
    equirect_directions,
    equirect_solid_angles,
    ray_lengths,
    rotation_about,
)
from tangent_train.geometry.sphere import area_mask
from tangent_train.heads import head_of
from tangent_train.heads.alignment import AlignedMosaic, from_distance, is_metric
from tangent_train.inference.api import Network, apply
from tangent_train.inference.engine import Predictor
from tangent_train.inference.images import InputImage
from tangent_train.inference.views import ViewSelector, view_settings
from tangent_train.kinds import DepthKind
from tangent_train.rendering import PerspectiveRepresentation
from tangent_train.rendering.representations.views import PinholeViews
from tests.inference.trained import CUBE, ERP, ICOSPHERE, TANGENT, trained_network

SHAPE = 96, 192
RING = view_settings("horizontal") | {"level": 5}
VIEWS: dict[str, dict[str, Any]] = {
    "tangent": TANGENT | {"level": 5, "levels": [5, 4], "rotations": 2},
    "horizontal": RING,
    "cube": CUBE | {"level": 5, "margin": 3},
    "equirectangular": ERP | {"level": 5, "rotations": 2},
    "icosphere": ICOSPHERE,
}


def _distance(directions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Distances of a smooth room in meters."""
    x, y, z = np.moveaxis(directions, -1, 0)
    return np.exp(0.7 + 0.3 * x + 0.2 * y * z - 0.1 * z)


def _truth(shape: tuple[int, int] = SHAPE) -> NDArray[np.float64]:
    return _distance(equirect_directions(shape))


def _true_depth(representation: dict[str, Any], kind: DepthKind) -> list[tuple[Any, Tensor]]:
    """Return the true depth of all views of a representation, rendered from a large panorama."""
    rotation = rotation_about((1, 2, 0), 0.4)
    built: Any = build_from_config(representation, "representation").with_rotation(rotation)
    panorama = torch.from_numpy(_truth((256, 512))).float()[None]
    found = []
    for views in built.view_sets():
        distance = views.render(panorama, "bilinear")
        lengths = torch.from_numpy(views.ray_lengths())[:, None]
        found.append((views, from_distance(distance, kind, lengths)))
    return found


def _combined(
    outputs: Any, shape: Any, kind: DepthKind, blend: Any, align: Any = None, **settings: Any
) -> NDArray[np.float32]:
    mosaic = AlignedMosaic(shape, kind, blend, align, **settings)
    for views, depth in outputs:
        mosaic.add(depth, views)
    distances: NDArray[np.float32] = mosaic.distances().numpy()
    return distances


def test_the_median_depth_of_a_photo_is_that_by_solid_angle() -> None:
    """A disk at 1 m that fills 55 % of the solid angle, 19 % of the pixels; the wall is at 3 m."""
    size = 192, 256
    camera = camera_matrix_from_fov(140.0, size)
    lengths = ray_lengths(camera, size)
    angles = lengths**-3.0
    edge = np.quantile(lengths, 0.55, weights=angles, method="inverted_cdf")
    z_depth = torch.from_numpy(np.where(lengths < edge, 1.0, 3.0)).float()
    photos = PerspectiveRepresentation(6, 45.0, (48, 64)).of_camera(camera, size)
    outputs = [(views, views.render(z_depth[None], "nearest")) for views in photos.view_sets()]
    found = _combined(outputs, size, "relative_depth", "nearest", "none", camera_matrix=camera)
    assert np.median(found / lengths) == pytest.approx(3, rel=0.01)


def test_relative_depth_beyond_100_medians_is_unknown() -> None:
    views = PinholeViews(TangentGrid(0, 5))
    up = torch.from_numpy(views.grid.directions()[..., 2])[:, None].float()
    depth = torch.where(up > 0.8, 150.0, torch.where(up > 0.5, 50.0, 1.0))
    distance = depth / torch.from_numpy(views.ray_lengths())[:, None]
    found = _combined([(views, distance)], SHAPE, "relative_depth", "nearest", "none")
    heights = equirect_directions(SHAPE)[..., 2]
    assert np.isnan(found[heights > 0.85]).all()
    np.testing.assert_allclose(found[(heights > 0.55) & (heights < 0.75)], 50, rtol=1e-4)


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        *(("horizontal", kind) for kind in get_args(DepthKind) if kind != "relative_points"),
        ("tangent", "relative_depth"),
        ("cube", "metric_z"),
        ("equirectangular", "canonical_inverse"),
        ("icosphere", "relative_disparity"),
    ],
)
def test_true_depth_of_views_is_that_of_the_panorama(name: str, kind: DepthKind) -> None:
    """Every view of every kind has its own scale, which only overlaps reveal."""
    outputs = _true_depth(VIEWS[name], kind)
    scaled, rng = [], np.random.default_rng(0)
    for views, depth in outputs:
        logs = torch.from_numpy(rng.normal(0, 0.2, (len(views), 1, 1, 1))).float()
        scaled.append((views, depth + logs if kind == "log_distance" else depth * logs.exp()))
    single = sum(len(views) for views, _ in outputs) == 1
    for blend in ("nearest", "feather"):
        found = _combined(scaled, SHAPE, kind, blend, "scale")
        assert found.dtype == np.float32
        assert found.shape == SHAPE
        ratio = found / _truth()
        np.testing.assert_allclose(ratio / np.median(ratio), 1, atol=0.02 if single else 0.01)
    plain = _combined(scaled, SHAPE, kind, "feather", "none") / _truth()
    assert name in ("equirectangular", "icosphere") or np.ptp(plain / np.median(plain)) > 0.1
    if is_metric(kind):
        exact = _combined(outputs, SHAPE, kind, "feather")
        np.testing.assert_allclose(exact, _truth(), rtol=0.02)


def test_relative_distances_have_the_median_1_by_solid_angle() -> None:
    outputs = []
    for views, depth in _true_depth(VIEWS["horizontal"], "relative_disparity"):
        up = torch.from_numpy(views.grid.directions()[..., 2])[:, None]
        outputs.append((views, 17 * depth.where(up.abs() < 0.6, depth / 4)))  # farther at the poles
    for shape, valid in (
        (SHAPE, None),
        (SHAPE, area_mask((-60, 100, -20, 70), SHAPE)),
        ((32, 64), None),  # fewer pixels than directions
    ):
        found = _combined(outputs, shape, "relative_disparity", "nearest", "none", valid=valid)
        inside = np.ones(shape, bool) if valid is None else valid
        values: Any = found[inside]
        weight = np.broadcast_to(equirect_solid_angles(shape)[:, None], shape)[inside]
        assert weight[values < 1].sum() / weight.sum() == pytest.approx(0.5, abs=0.015)


def test_the_sky_and_unknown_pixels_are_unknown() -> None:
    """Disparity 0 is infinitely far, and is not mixed into the depth beside it."""
    outputs = []
    for views, depth in _true_depth(VIEWS["horizontal"], "relative_disparity"):
        up = torch.from_numpy(views.grid.directions()[..., 2])[:, None]
        outputs.append((views, depth.where(up < 0.6, 0).where(up > -0.8, torch.nan)))
    found = _combined(outputs, SHAPE, "relative_disparity", "feather")
    heights = equirect_directions(SHAPE)[..., 2]
    assert np.isnan(found[(heights > 0.75) | (heights < -0.92)]).all()
    inside = (heights < 0.45) & (heights > -0.7)
    ratio = found[inside] / _truth()[inside]
    np.testing.assert_allclose(ratio / np.median(ratio), 1, atol=0.02)
    assert np.nanmax(found) <= 100  # between the sky and a wall, disparity falls to 0


# Networks.


class RedIsFar(nn.Module):
    """Depth is proportional to red, and to the mean of green: every view has its own scale."""

    def __init__(self, kind: DepthKind = "metric_distance") -> None:
        super().__init__()
        self.kind = kind
        self.lengths = torch.from_numpy(PinholeViews(TangentGrid(0, 5)).ray_lengths())

    def forward(self, images: Tensor) -> Tensor:
        scale = 2 ** (images[:, 1:2].mean(dim=(2, 3), keepdim=True) - 0.5)
        distance = 4 * images[:, :1] * scale
        if self.kind == "metric_distance":
            return distance
        return from_distance(distance, self.kind, self.lengths)


def depth_network(kind: DepthKind = "metric_distance", **changes: Any) -> LoadedNetwork:
    """Return a network whose distance in meters is 4 · red (0 to 1), times a scale per view."""
    settings: dict[str, Any] = {
        "module": RedIsFar(kind),
        "class_names": (),
        "depth_kind": kind,
        "normalization": Normalization([0.0] * 3, [1.0] * 3),
    }
    return trained_network(TANGENT | {"level": 5}, **(settings | changes))


def far_image(distance: NDArray[np.float64], green: Any = 128) -> NDArray[np.uint8]:
    """Return the image of distances up to 4 m."""
    red = np.rint(distance / 4 * 255).astype(np.uint8)
    return np.stack([red, np.broadcast_to(np.uint8(green), red.shape), red], axis=-1)


@pytest.mark.parametrize("kind", ["log_distance", "relative_disparity"])
def test_a_predictor_aligns_what_its_network_scales(kind: DepthKind) -> None:
    directions = equirect_directions(SHAPE)
    image = InputImage(far_image(_truth(), 128 + 100 * directions[..., 1]))
    trained = depth_network(kind)
    shares: list[float] = []
    found = {}
    for align in ("none", None):
        head = head_of(trained, align=align)
        predictor = Predictor(trained, head, ViewSelector(trained), view_batch_size=3)
        result = predictor.predict(image, shares.append)
        ratio = result.pixels().numpy() / _truth()
        found[align] = np.log(ratio / np.median(ratio)).std()
    assert sum(shares) == pytest.approx(2)
    assert found["none"] > 0.08
    assert found[None] < 0.02
    before, after = result.facts["step_before"], result.facts["step_after"]
    assert before is not None
    assert after is not None
    assert after < 0.2 * before


def _photo(size: tuple[int, int], fov_deg: float) -> tuple[InputImage, NDArray[np.float64]]:
    """Return a photo of a tilted plane, and its z-depth."""
    matrix = camera_matrix_from_fov(fov_deg, size)
    matrix[:2, 2] += 7, -4
    v, u = np.indices(size, np.float64)
    x, y = (u - matrix[0, 2]) / matrix[0, 0], (v - matrix[1, 2]) / matrix[1, 1]
    z_depth = 1.5 / (1 + 0.3 * x - 0.2 * y)
    distance = z_depth * np.sqrt(1 + x**2 + y**2)
    return InputImage(far_image(distance, 100 + u), camera_matrix=matrix), z_depth


@pytest.mark.parametrize(("size", "fov"), [((60, 90), 70), ((20, 26), 25)])
def test_photos_get_z_depth(size: tuple[int, int], fov: float) -> None:
    """Several crops with one optical axis, and one crop that is larger than the photo."""
    photo, z_depth = _photo(size, fov)
    trained = depth_network()
    for blend in ("nearest", "feather"):
        found = Predictor(trained, head_of(trained), ViewSelector(trained, blend=blend)).predict(
            photo
        )
        ratio = (found.pixels().numpy() / z_depth)[2:-2, 2:-2]
        np.testing.assert_allclose(ratio / np.median(ratio), 1, atol=0.03)
        assert 0.7 < np.median(ratio) < 1.5, "meters remain meters"


# Python.


@pytest.fixture
def network(monkeypatch: pytest.MonkeyPatch) -> Network:
    return loaded(depth_network(), monkeypatch)


def loaded(trained: LoadedNetwork, monkeypatch: pytest.MonkeyPatch, **settings: Any) -> Network:
    """Return a network as `load` does, without a file."""
    monkeypatch.setattr("tangent_train.inference.api.load_network", lambda *_: trained)
    return tt.load("net.ckpt", **settings)


def test_files_arrays_and_tensors_get_the_same_depth(network: Network, tmp_path: Path) -> None:
    panorama = far_image(_truth())
    depth = network.depth(panorama)
    assert depth.dtype == np.float32
    assert depth.shape == SHAPE
    np.testing.assert_allclose(depth, _truth(), atol=0.03)
    Image.fromarray(panorama).save(tmp_path / "room.png")
    np.testing.assert_array_equal(network.depth(tmp_path / "room.png"), depth)
    tensor = network.depth(torch.from_numpy(panorama).movedim(-1, 0))
    assert tensor.dtype == torch.float32
    np.testing.assert_array_equal(tensor.numpy(), depth)
    masked = network.depth(panorama, mask=-45)
    below = np.isnan(masked)
    assert below[-20:].all()
    np.testing.assert_array_equal(masked[~below], depth[~below])
    found = network.depth(far_image(np.full((60, 90), 2.0)), fov=70)
    x = np.abs(np.arange(90) - 44.5) / camera_matrix_from_fov(70, (60, 90))[0, 0]
    np.testing.assert_allclose(found[30], 2 / np.hypot(1, x), rtol=0.02)


def test_parts_of_panoramas_get_their_depth(network: Network, tmp_path: Path) -> None:
    """The surroundings of a part, which the network sees filled, do not affect it."""
    part = np.s_[16:64, 40:150]
    area = [-105.0, 101.25, -30.0, 60.0]
    depth = network.depth(far_image(_truth())[part], area=area)
    assert depth.shape == (48, 110)
    inside = np.s_[4:-4, 4:-4]  # the network sees edges beside the mean color
    np.testing.assert_allclose(depth[inside], _truth()[part][inside], rtol=0.02)


def test_networks_name_the_method_that_suits_them(
    network: Network, monkeypatch: pytest.MonkeyPatch
) -> None:
    classes, panorama = loaded(trained_network(TANGENT), monkeypatch), far_image(_truth())
    for method in (network.labels, network.probabilities):
        with pytest.raises(SettingError, match=r"predicts distance; expected .*Use depth\(\)"):
            method(panorama)
    with pytest.raises(SettingError, match=r"predicts pixel_classes; .*Use labels\(\) or prob"):
        classes.depth(panorama)
    with pytest.raises(ValueError, match="min_confidence"):
        loaded(depth_network(), monkeypatch, min_confidence=0.5)


# Functions.


@pytest.mark.parametrize("as_tensor", [False, True])
def test_functions_that_return_depth_are_aligned(as_tensor: bool) -> None:
    """A function returns z-depth of each image in another unit."""
    grid = TangentGrid(0, 6, dim=64)
    lengths = PinholeViews(grid).ray_lengths()
    distance = _truth((128, 256)).astype(np.float32)
    panorama: Any = torch.from_numpy(distance)[None] if as_tensor else distance[..., None]
    rng = np.random.default_rng(0)

    def z_depth(images: Any) -> Any:
        scale = rng.uniform(0.5, 2, (len(images), 1, 1)).astype(np.float32)
        if as_tensor:
            return images * torch.from_numpy(scale / lengths)[:, None]
        return images[..., 0] * scale / lengths

    aligned: Any = apply(z_depth, panorama, grid, align="scale", images_per_call=7)
    ratio = np.asarray(aligned) / distance
    assert ratio.shape == (128, 256)
    np.testing.assert_allclose(ratio / np.median(ratio), 1, atol=0.01)
    assert isinstance(aligned, Tensor) == as_tensor
    plain: Any = apply(z_depth, panorama, grid, align="none")
    assert np.ptp(np.log(np.asarray(plain) / distance)) > 0.3
    with pytest.raises(SettingError, match="and float32; expected depth for"):
        apply(lambda images: images.repeat(2, axis=-1), distance[..., None], grid, align="scale")
