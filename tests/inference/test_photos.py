"""Labels of photos."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import torch

from datamodules.core.photos import distance_from_z_depth
from datamodules.core.samples import normalize
from tangent_train.errors import SettingError
from tangent_train.geometry import TangentGrid, camera_matrix_from_fov
from tangent_train.inference.photos import PhotoPredictor
from tangent_train.inference.predictor import InputImage, Prediction, Runner
from tangent_train.inference.seen import photo_representation
from tests.inference.trained import (
    CUBE,
    ERP,
    PERSPECTIVE,
    TANGENT,
    color_network,
    trained_network,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tangent_train.checkpoints.trained import TrainedNetwork
    from tangent_train.rendering import Blend


def _blocks(height: int, width: int) -> NDArray[np.uint8]:
    rng = np.random.default_rng(height * width)
    blocks = rng.integers(0, 256, (-(-height // 6), -(-width // 6), 3), np.uint8)
    return blocks.repeat(6, axis=0).repeat(6, axis=1)[:height, :width]


def _predict(
    trained: TrainedNetwork, image: InputImage, fov_deg: float, **settings: Any
) -> Prediction:
    shape = image.rgb.shape[0], image.rgb.shape[1]
    shares: list[float] = []
    predictor = PhotoPredictor(trained, Runner(trained), **settings)
    prediction = predictor.predict(image, camera_matrix_from_fov(fov_deg, shape), shares.append)
    assert sum(shares) == pytest.approx(1)
    return prediction


def _fov_deg(trained: TrainedNetwork, width: int) -> float:
    """Of a photo of this width whose pixels are those of the network's crops."""
    crop = photo_representation(trained)
    extent = math.tan(math.radians(crop.fov_deg) / 2) * width / crop.image_size[1]
    return 2 * math.degrees(math.atan(extent))


@pytest.mark.parametrize("size", [(24, 24), (48, 72), (10, 61), (7, 9)])
@pytest.mark.parametrize("channels", [3, 4])
@pytest.mark.parametrize("blend", ["nearest", "feather"])
def test_photos_with_the_networks_pixels_are_labelled_pixel_by_pixel(
    blend: Blend, channels: int, size: tuple[int, int]
) -> None:
    """Crops that lie on the photo's pixels, one network for every pixel: nothing may move."""
    network = color_network(channels, kernel=1)
    trained = trained_network(PERSPECTIVE, channels, network=network)
    rgb = _blocks(*size)
    z_depth = None
    inputs = [torch.from_numpy(rgb)[None]]
    fov_deg = _fov_deg(trained, size[1])
    if channels == 4:
        z_depth = 300 + 5 * rgb[..., 0].astype(np.uint16)
        depth = distance_from_z_depth(z_depth, camera_matrix_from_fov(fov_deg, size))
        inputs.append(torch.from_numpy(depth.astype(np.int32))[None])
    with torch.no_grad():
        images = normalize(inputs, trained.normalization, trained.inputs)
        expected = network(images)[0, 1:].argmax(0).numpy()
    image = InputImage(rgb, z_depth)
    prediction = _predict(trained, image, fov_deg, blend=blend)
    labels = prediction.mosaic.labels()
    if blend == "nearest" and size != (10, 61):
        # Crops are at whole pixels, or their one is as large as the photo.
        np.testing.assert_array_equal(labels, expected)
    else:
        assert (labels == expected).mean() > 0.9


def test_a_photo_of_any_resolution_is_seen_at_the_networks() -> None:
    trained = trained_network(PERSPECTIVE)
    fine, coarse = _blocks(96, 96).repeat(3, axis=0).repeat(3, axis=1), _blocks(96, 96)
    labels = _predict(trained, InputImage(fine), 60.0).mosaic.labels()
    expected = _predict(trained, InputImage(coarse), 60.0).mosaic.labels()
    assert labels.shape == (288, 288)
    assert (labels[1::3, 1::3] == expected).mean() > 0.95


def test_crops_have_the_angular_resolution_the_network_was_trained_with() -> None:
    def radians_per_pixel(trained: TrainedNetwork, **settings: Any) -> float:
        crop = photo_representation(trained, **settings)
        return 2 * math.tan(math.radians(crop.fov_deg) / 2) / crop.image_size[1]

    tangent = trained_network(TANGENT)
    assert radians_per_pixel(tangent) == pytest.approx(TangentGrid(0, 4).pitch)
    assert radians_per_pixel(tangent, level=5) == pytest.approx(TangentGrid(0, 5).pitch)
    assert radians_per_pixel(tangent, base_level=1) == pytest.approx(TangentGrid(1, 4).pitch)
    photos = trained_network(PERSPECTIVE)
    at_45 = 2 * math.tan(math.radians(22.5)) / 24
    assert radians_per_pixel(photos) == pytest.approx(at_45)
    assert radians_per_pixel(photos, level=7) == pytest.approx(at_45 / 2)
    assert photo_representation(photos, level=7).image_size == (24, 24)
    assert radians_per_pixel(trained_network(ERP)) == pytest.approx(TangentGrid(1, 4).pitch)
    assert radians_per_pixel(trained_network(CUBE)) == pytest.approx(2 / 16)


def test_the_level_of_a_photo_is_that_of_panoramas_with_its_resolution() -> None:
    trained = trained_network(PERSPECTIVE)
    # 90° over 128 pixels: a focal length of 64, π·64 ≈ 201 rows, nearest to the 256 of level 7.
    prediction = _predict(trained, InputImage(_blocks(128, 128)), 90.0, level="image")
    assert prediction.level == 7
    assert prediction.grid is None


def test_crops_the_network_cannot_take_are_refused() -> None:
    trained = trained_network(TANGENT, size_multiple=16)
    with pytest.raises(SettingError, match="multiples of 16"):
        PhotoPredictor(trained, Runner(trained), level=3)


def test_a_photo_of_a_telescope_needs_little_memory() -> None:
    """Far smaller than a crop: mirrored at full resolution it would have 14,000² pixels."""
    trained = trained_network(PERSPECTIVE, network=color_network(kernel=1))
    rgb = np.zeros((600, 800, 3), np.uint8)
    rgb[:, 400:] = 255
    labels = _predict(trained, InputImage(rgb), 2.5).mosaic.labels()
    assert (labels[:, :330] == labels[0, 0]).all()
    assert (labels[:, 470:] == labels[0, -1]).all()
    assert labels[0, 0] != labels[0, -1]
