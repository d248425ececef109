"""Labels of panoramas: as in an evaluation, and of any size."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pytest
import torch

from datamodules import Stanford2D3DS
from tangent_train.errors import SettingError
from tangent_train.geometry import equirect_directions
from tangent_train.tasks.networks import make
from tangent_train.tasks.prediction.panoramas import PanoramaPredictor, turns
from tangent_train.tasks.prediction.predictor import InputImage, Prediction, Runner
from tangent_train.tasks.prediction.seen import panorama_representation
from tangent_train.tasks.segmentation import SegmentationTask
from tests.tasks.prediction.trained import CUBE, ERP, PERSPECTIVE, TANGENT, trained_network

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from tangent_train.tasks.networks import TrainedNetwork


def _predict(
    trained: TrainedNetwork, image: InputImage, at_once: int | None = None, **settings: Any
) -> Prediction:
    predictor = PanoramaPredictor(trained, Runner(trained, "cpu", at_once), **settings)
    shares: list[float] = []
    prediction = predictor.predict(image, shares.append)
    assert sum(shares) == pytest.approx(1)
    return prediction


def _sphere(height: int, width: int | None = None) -> NDArray[np.uint8]:
    """Colours that are smooth on the sphere."""
    x, y, z = np.moveaxis(equirect_directions((height, width or 2 * height)), -1, 0)
    return np.stack([128 + 120 * x, 128 + 120 * y * z, 128 + 120 * z], axis=-1).astype(np.uint8)


@pytest.mark.parametrize("channels", [3, 4])
@pytest.mark.parametrize(
    ("representation", "blend"),
    [
        (TANGENT, "nearest"),
        (TANGENT | {"blend": "feather"}, "feather"),
        (TANGENT | {"crop_multiple": 2}, "nearest"),
        (ERP, "feather"),  # there is nothing to blend
        (CUBE, "feather"),  # its faces do not overlap
    ],
)
def test_labels_are_those_of_an_evaluation(
    stanford_root: Path, representation: dict[str, Any], blend: str, channels: int
) -> None:
    trained = trained_network(representation, channels)
    made = make(representation)
    data = Stanford2D3DS(
        root=str(stanford_root), representation=made, inputs=trained.inputs, fold=1
    )
    task = SegmentationTask(
        trained.network, made, trained.class_names, functools.partial(torch.optim.SGD, lr=1.0)
    )
    batch = next(iter(data.test_dataloader()))
    batch = data.on_after_batch_transfer(batch, 0)
    expected = task.predict_labels(batch.images[0], tuple(batch.target[0].shape)).numpy()
    image = data.source("test").read(int(batch.index[0]))
    prediction = _predict(trained, InputImage(image.rgb, image.depth), blend=blend)
    assert len(np.unique(expected)) == 3
    np.testing.assert_array_equal(prediction.mosaic.labels() + 1, expected)


@pytest.mark.parametrize("at_once", [1, 7, 1000])
def test_the_number_of_images_at_once_changes_nothing(at_once: int) -> None:
    image, trained = InputImage(_sphere(32)), trained_network(TANGENT)
    expected = _predict(trained, image).mosaic.labels()
    np.testing.assert_array_equal(_predict(trained, image, at_once).mosaic.labels(), expected)


@pytest.mark.parametrize("representation", [TANGENT, ERP, CUBE])
@pytest.mark.parametrize("height", [16, 32, 50, 96])
def test_panoramas_of_any_size_get_labels_of_their_size(
    representation: dict[str, Any], height: int
) -> None:
    """Smooth colours: the labels of another size are those of a network that sees every pixel."""
    rgb = _sphere(height)
    trained = trained_network(representation)
    labels = _predict(trained, InputImage(rgb)).mosaic.labels()
    assert labels.shape == (height, 2 * height)
    finest = trained_network(ERP | {"erp_height": height})
    expected = _predict(finest, InputImage(rgb)).mosaic.labels()
    assert (labels == expected).mean() > 0.9


@pytest.mark.parametrize("representation", [TANGENT, ERP, CUBE])
def test_nothing_changes_at_180_degrees(representation: dict[str, Any]) -> None:
    """A panorama turned by a half has the labels turned by a half, seam or not.

    Not quite where images near the poles are turned in themselves: the network is not symmetric.
    """
    trained, rgb = trained_network(representation), _sphere(64)
    labels = _predict(trained, InputImage(rgb), blend="nearest").mosaic.labels()
    turned = np.ascontiguousarray(np.roll(rgb, 64, axis=1))
    there = _predict(trained, InputImage(turned), blend="nearest").mosaic.labels()
    agreement = (np.roll(there, -64, axis=1) == labels).mean()
    assert agreement > (0.999 if representation is ERP else 0.97)


def test_a_larger_panorama_is_shrunk_without_aliasing() -> None:
    """A checkerboard finer than the network's pixels is grey to it."""
    board = (np.indices((128, 256)).sum(axis=0) % 2 * 255).astype(np.uint8)
    rgb = cv2.cvtColor(board, cv2.COLOR_GRAY2RGB)
    grey = np.full_like(rgb, 128)
    trained = trained_network(TANGENT)
    labels = _predict(trained, InputImage(rgb)).mosaic.labels()
    expected = _predict(trained, InputImage(grey)).mosaic.labels()
    np.testing.assert_array_equal(labels, expected)


def test_rotations_are_turned_about_the_vertical_and_averaged() -> None:
    rotations = turns(3)
    assert rotations[0] is None
    for k, rotation in enumerate(rotations[1:], start=1):
        assert rotation is not None
        np.testing.assert_allclose(rotation @ [0, 0, 1], [0, 0, 1], atol=1e-12)
        assert np.degrees(np.arctan2(rotation[1, 0], rotation[0, 0])) == pytest.approx(24 * k)
    prediction = _predict(trained_network(TANGENT), InputImage(_sphere(32)), rotations=3)
    assert prediction.views == 60
    sums = prediction.mosaic.probabilities(slice(None)).sum(axis=-1)
    np.testing.assert_allclose(sums, 1, atol=1e-5)


def test_levels() -> None:
    trained, image = trained_network(TANGENT), InputImage(_sphere(128))
    assert _predict(trained, image).level == 4
    assert _predict(trained, image, level=5).grid == panorama_representation(trained, 5).grid  # type: ignore[union-attr]
    by_image = _predict(trained, image, level="image")
    assert (by_image.level, by_image.grid and by_image.grid.dim) == (6, 64)
    other = _predict(trained, image, base_level=1)
    assert (other.views, other.grid and other.grid.dim) == (80, 8)


def test_networks_trained_on_photos_see_tangent_images() -> None:
    prediction = _predict(trained_network(PERSPECTIVE), InputImage(_sphere(64)))
    assert prediction.grid is not None
    assert (prediction.views, prediction.level, prediction.grid.dim) == (80, 6, 32)


def test_impossible_settings_are_refused() -> None:
    with pytest.raises(SettingError, match="rotations: found 0"):
        turns(0)
    image = InputImage(_sphere(32))
    with pytest.raises(SettingError, match=r"rotations: found 2.*base_level="):
        _predict(trained_network(ERP), image, rotations=2)
    with pytest.raises(SettingError, match="multiples of 16"):
        _predict(trained_network(TANGENT, size_multiple=16), image, level=3)
    with pytest.raises(SettingError, match=r"those of 16×16"):
        _predict(trained_network(TANGENT, fixed_size=(16, 16)), image, level=5)
    trained = trained_network(TANGENT)
    with pytest.raises(SettingError, match="images_per_forward"):
        Runner(trained, "cpu", 0)
    with pytest.raises(SettingError, match="device"):
        Runner(trained, "nonsense")
