"""Metric networks that are right for one camera, and networks that take the camera as an input."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from datamodules.core.inputs import Normalization
from tangent_train.checkpoints.loaded import LoadedNetwork
from tangent_train.config.build import build_from_config
from tangent_train.geometry.camera import half_width
from tangent_train.heads import head_of
from tangent_train.inference.engine import Predictor
from tangent_train.inference.images import InputImage
from tangent_train.inference.views import ViewSelector, panorama_settings, view_settings
from tangent_train.photo_networks import PhotoNetwork, import_network
from tests.inference.trained import TANGENT, trained_network

FOV_DEG = (62.0, 48.0)
UNIT = Normalization([0.0] * 3, [1.0] * 3)
STRETCHED = view_settings("horizontal_camera") | {"level": 6, "dim": [48, 48]}
VIEWS: dict[str, dict[str, Any]] = {
    "tangent": TANGENT | {"level": 6},
    "horizontal": view_settings("horizontal") | {"level": 6, "dim": [40, 64]},
    "like the photos": STRETCHED | {"fov": list(FOV_DEG)},
    "wider, stretched": STRETCHED | {"fov": [100, 80]},
}


class SizeIsDistance(nn.Module):
    """Takes every view for a photo of its training, in which all things have another size.

    Args:
        representation: Views of a wall at a distance of 3 m, which red marks.
    """

    def __init__(self, representation: dict[str, Any]) -> None:
        super().__init__()
        built: Any = build_from_config(representation, "representation")
        (self.views,) = built.view_sets()

    def forward(self, images: Tensor) -> Tensor:
        z_depth = 3 * images[:, :1] / torch.from_numpy(self.views.ray_lengths())
        return z_depth * self.views.grid.half_size[0] / half_width(FOV_DEG[0])


class KnowsTheFocalLength(SizeIsDistance):
    """Is given the camera matrix of each view, and corrects its error."""

    calls = 0

    def forward(self, images: Tensor, camera_matrix: Tensor) -> Tensor:  # type: ignore[override]
        self.calls += 1
        assert camera_matrix.shape == (len(images), 3, 3)
        expected = torch.from_numpy(self.views.grid.camera_matrix).float()
        torch.testing.assert_close(camera_matrix, expected.expand_as(camera_matrix))
        half_widths = images.shape[-1] / 2 / camera_matrix[:, 0, 0]
        return super().forward(images) * half_width(FOV_DEG[0]) / half_widths.view(-1, 1, 1, 1)


def network(module: SizeIsDistance, name: str, **changes: Any) -> LoadedNetwork:
    described: dict[str, Any] = {"class_names": (), "normalization": UNIT, **changes}
    return trained_network(VIEWS[name], module=module, **described)


def distances(loaded: LoadedNetwork) -> Any:
    image = InputImage(np.full((64, 128, 3), 255, np.uint8))
    head = head_of(loaded, align="none")
    return Predictor(loaded, head, ViewSelector(loaded), view_batch_size=7).predict(image).pixels()


@pytest.mark.parametrize("name", VIEWS)
def test_depth_follows_the_focal_length_of_a_view(name: str) -> None:
    module = SizeIsDistance(VIEWS[name])
    found = distances(network(module, name, depth_kind="canonical_z", photo_fov_deg=FOV_DEG))
    torch.testing.assert_close(found, torch.full_like(found, 3.0), rtol=1e-3, atol=0)
    ignored = distances(network(module, name, depth_kind="metric_z"))
    ratio = module.views.grid.half_size[0] / half_width(FOV_DEG[0])
    torch.testing.assert_close(ignored, torch.full_like(found, 3 * ratio), rtol=1e-3, atol=0)
    assert (name == "like the photos") is (abs(ratio - 1) < 1e-9)


@pytest.mark.parametrize("name", VIEWS)
def test_a_network_may_take_the_camera_of_each_view(name: str) -> None:
    module = KnowsTheFocalLength(VIEWS[name])
    found = distances(network(module, name, depth_kind="metric_z"))
    torch.testing.assert_close(found, torch.full_like(found, 3.0), rtol=1e-3, atol=0)
    assert module.calls == -(-module.views.num_images // 7)


class OneSize(nn.Conv2d):
    fixed_size = 32, 32


def imported(path: Path, **settings: Any) -> LoadedNetwork:
    """Return a depth network of images of 32 × 32 pixels, read from its file."""
    torch.manual_seed(0)
    described: dict[str, Any] = {"in_channels": 3, "out_channels": 1, "kernel_size": 1}
    module = OneSize(**described)
    named = {"_target_": "tests.inference.test_focal_length.OneSize", **described}
    photo_network = PhotoNetwork(module, named, (), UNIT, (32, 32), depth_kind="metric_z")
    return import_network(photo_network, path, **settings)


def test_a_file_stores_the_camera(tmp_path: Path) -> None:
    trained = imported(tmp_path / "one.ckpt", fov_deg=FOV_DEG, views="horizontal_camera")
    assert (trained.photo_fov_deg, trained.depth_kind) == (FOV_DEG, "canonical_z")
    stored = ViewSelector(trained).representation
    for seen in (stored, ViewSelector(replace(trained), views="horizontal_camera").representation):
        assert seen.image_size == (32, 32)
        assert np.degrees(2 * np.arctan(seen.grid.half_size)) == pytest.approx(FOV_DEG)
        assert seen.grid == stored.grid
        assert seen.erp_height == stored.erp_height
    changed = panorama_settings(trained, views={"option": "horizontal_camera", "fov": [80, 60]})
    assert (changed["fov"], changed["dim"]) == ([80, 60], [32, 32])
    images = torch.rand(2, 3, 32, 32)
    gain = 2 * half_width(FOV_DEG[0])
    torch.testing.assert_close(trained.network(images), trained.module(images) * gain)


def test_one_number_is_the_width_of_square_pixels(tmp_path: Path) -> None:
    trained = imported(tmp_path / "one.ckpt", fov_deg=70.0)
    assert trained.photo_fov_deg == pytest.approx((70, 70))
    unknown = imported(tmp_path / "other.ckpt")
    assert (unknown.photo_fov_deg, unknown.depth_kind) == (None, "metric_z")
