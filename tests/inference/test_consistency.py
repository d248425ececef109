"""Consistency under rotations: networks whose agreement is known in closed form."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from datamodules.core.inputs import RGB_NORMALIZATION
from tangent_train.geometry import random_rotation
from tangent_train.heads import PredictedImage, head_of
from tangent_train.inference.engine import Predictor
from tangent_train.inference.images import InputImage
from tangent_train.inference.views import ViewSelector
from tangent_train.io.gpano import PanoramaArea
from tests.inference.trained import CUBE, ERP, TANGENT, color_network, sphere, trained_network


class Halves(nn.Module):
    """Labels 1 and 2 for the halves of an image along an axis, whatever it shows."""

    num_outputs = 3

    def __init__(self, axis: int) -> None:
        super().__init__()
        self.axis = axis

    def forward(self, images: Tensor) -> Tensor:
        first = torch.zeros_like(images)
        rows = first.movedim(self.axis, 0)
        half = len(rows) // 2
        rows[:half, :, 0], rows[half:, :, 1] = 1, 1
        return first


class Blue(nn.Module):
    """The distance is 1 + the blue channel, of 0 to 1."""

    def forward(self, images: Tensor) -> Tensor:
        return 1 + images[:, 2:] * RGB_NORMALIZATION.std[2] + RGB_NORMALIZATION.mean[2]


class Above(nn.Module):
    """Labels 1 and 2 above and below the horizon."""

    num_outputs = 3

    def forward(self, images: Tensor) -> Tensor:
        elevation = images[:, 3:]
        return torch.cat([elevation, -elevation, elevation - 1e3], dim=1)


def _tilts(number: int) -> list[float]:
    """Return the tilts of the random rotations, as shares of 180°."""
    rng = np.random.default_rng(3)
    return [float(np.arccos(random_rotation(rng)[2, 2]) / np.pi) for _ in range(number)]


def _consistency(image: InputImage, views: dict[str, Any], number: int, **network: Any) -> Any:
    trained = trained_network(views, **network)
    selector = ViewSelector(trained, blend="nearest")
    predictor = Predictor(trained, head_of(trained), selector)
    return predictor.consistency(image, number, np.random.default_rng(3))


def test_a_network_of_single_pixels_is_consistent_under_turns_by_whole_columns() -> None:
    """As one that has no borders: the image and its scores are not interpolated."""
    noise = np.random.default_rng(0).integers(0, 256, (32, 64, 3), np.uint8)
    found = _consistency(InputImage(noise), ERP, 8, module=color_network(kernel=1))
    assert found["consistency_labels_yaw"] == found["consistency_miou_yaw"] == 1
    assert found["consistency_labels_so3"] < 0.9, "noise does not survive interpolation"
    bordered = _consistency(InputImage(noise), ERP, 8, module=color_network(kernel=3))
    assert 0.9 < bordered["consistency_labels_yaw"] < 1
    found = _consistency(InputImage(noise), ERP | {"rows": 16}, 8, module=color_network(kernel=1))
    assert found["consistency_labels_yaw"] == 1, "columns of the network's image"


@pytest.mark.parametrize("views", [TANGENT, CUBE, ERP])
def test_interpolation_of_a_smooth_image_changes_few_labels(views: dict[str, Any]) -> None:
    found = _consistency(InputImage(sphere(64)), views, 3, module=color_network(kernel=1))
    assert min(found.values()) > 0.95


def test_a_network_of_image_halves_has_a_known_consistency() -> None:
    """Left and right agree on 1 − α / 180° of the sphere after a turn by α ≤ 180°.

    Above and below agree on 1 − θ / 180° after a rotation that tilts the zenith by θ.
    """
    image = InputImage(sphere(64))
    views = ERP | {"level": 5}
    found = _consistency(image, views, 3, module=Halves(-1))
    equal = np.array([1 / 2, 0, 1 / 2])
    assert found["consistency_labels_yaw"] == pytest.approx(equal.mean(), abs=0.01)
    # Intersection and union of two halves that share half of their area each.
    assert found["consistency_miou_yaw"] == pytest.approx(((1 / 4) / (3 / 4) * 2) / 3, abs=0.01)
    found = _consistency(image, views, 5, module=Halves(-2))
    assert found["consistency_labels_yaw"] == 1
    assert found["consistency_labels_so3"] == pytest.approx(1 - np.mean(_tilts(5)), abs=0.01)


def test_pixels_outside_a_partial_panorama_and_the_tilt_do_not_count() -> None:
    area = PanoramaArea.on_canvas((-60, 60, -45, 45), 64)
    rgb = np.where(np.array(area.valid)[..., None], sphere(64), np.uint8(0))
    image = InputImage(rgb, area=area, up=np.array([0.0, 0.6, 0.8]))
    found = _consistency(image, TANGENT, 2, module=color_network(kernel=1))
    assert found["consistency_labels_so3"] > 0.97
    assert found["consistency_labels_yaw"] > 0.97


@pytest.mark.parametrize("views", [TANGENT, ERP])
def test_the_elevation_of_pixels_is_that_of_the_rotated_panorama(views: dict[str, Any]) -> None:
    network: dict[str, Any] = {"module": Above(), "inputs": ("rgb", "elevation")}
    found = _consistency(InputImage(sphere(64)), views, 5, **network)
    assert found["consistency_labels_yaw"] > 0.98
    assert found["consistency_labels_so3"] == pytest.approx(1 - np.mean(_tilts(5)), abs=0.02)


def test_the_change_of_distances_is_a_median_by_solid_angle() -> None:
    network: dict[str, Any] = {"class_names": (), "depth_kind": "metric_distance"}
    found = _consistency(InputImage(sphere(64)), ERP, 4, module=Blue(), **network)
    assert found["consistency_distance_yaw"] == pytest.approx(0, abs=1e-6)
    assert 0 < found["consistency_distance_so3"] < 0.01
    head = head_of(trained_network(ERP, module=Blue(), **network))
    image, first = InputImage(sphere(36)), np.full((36, 72), 2, np.float32)
    other = first.copy()
    other[:10], other[-10:], other[10:-10] = 4, np.nan, 2.5
    given = PredictedImage(image, first), PredictedImage(image, other)
    # Above 40° are 10 of 26 rows, and 18 % of the solid angle; those below -40° are unknown.
    assert head.agreement(*given) == {"distance": pytest.approx(0.25)}
    other[10:16] = 4  # above 10°: 16 of 26 rows, but 0.5027 of the rest
    assert head.agreement(*given) == {"distance": 1}
    other[15] = 2.5
    assert head.agreement(*given) == {"distance": pytest.approx(0.25)}
