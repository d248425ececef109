"""Labels of panoramas: as in an evaluation, and of any size."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pytest
import torch

from datamodules import Stanford2D3DS
from datamodules.core.samples import normalize, render_inputs
from tangent_train.checkpoints.trained import Scores
from tangent_train.errors import SettingError
from tangent_train.geometry import equirect_directions, rotation_about
from tangent_train.inference.panoramas import PanoramaPredictor
from tangent_train.inference.predictor import InputImage, Prediction, Runner
from tangent_train.inference.seen import panorama_representation
from tangent_train.registry import make
from tangent_train.rendering import rotate_equirect
from tangent_train.rendering.representations.pinhole import turns
from tangent_train.tasks.segmentation import SegmentationTask
from tests.inference.trained import CUBE, ERP, PERSPECTIVE, TANGENT, trained_network
from tests.models.sphere_networks import awake, small_context

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from tangent_train.checkpoints.trained import TrainedNetwork


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
    made = make(representation, "representation")
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


@pytest.mark.parametrize("at_once", [7, 1000])
def test_images_of_a_sphere_see_each_other_as_in_an_evaluation(at_once: int) -> None:
    torch.manual_seed(0)
    network = small_context().eval()
    awake(network)
    image, made = InputImage(_sphere(32)), make(TANGENT, "representation")
    trained = trained_network(TANGENT, network=Scores(network))
    labels = _predict(trained, image, at_once, blend="nearest").mosaic.labels()
    task = SegmentationTask(
        network, made, trained.class_names, functools.partial(torch.optim.SGD, lr=1.0)
    ).eval()
    whole = made.whole()
    images = normalize(
        render_inputs(image, whole, trained.inputs), trained.normalization, trained.inputs
    )
    rays = torch.tensor(whole.rays())
    expected = task.predict_labels(images, (32, 64), rays).numpy() - 1
    np.testing.assert_array_equal(labels, expected)
    assert len(np.unique(labels)) > 1
    with torch.no_grad():
        difference = task(images, rays[None]) - task(images)
    assert difference.abs().max() > 0.01, "the context does something"


def test_a_network_is_shown_how_far_up_it_looks() -> None:
    """Its only input that matters: what is above the horizon is bright, what is below dark."""
    network = torch.nn.Conv2d(4, 4, 1)
    with torch.no_grad():
        network.weight.zero_()
        network.weight[1, 3], network.weight[3, 3] = -1, 1
        network.bias.copy_(torch.tensor([9.0, 0, -9, 0]))  # type: ignore[union-attr]
    trained = trained_network(TANGENT, network=network, inputs=("rgb", "elevation"))
    labels = _predict(trained, InputImage(_sphere(32))).mosaic.labels()
    assert (labels[:15] == 2).all()
    assert (labels[17:] == 0).all()
    up = np.array([1.0, 0.0, 0.0])  # tilted forwards by a right angle
    tilted = _predict(trained, InputImage(_sphere(32), up=up)).mosaic.labels()
    assert (tilted[:, 20:44] == 2).mean() > 0.85, "around the middle column"
    assert (tilted[:, [0, 63]] == 0).mean() > 0.85


def test_a_tilted_panorama_is_looked_at_upright() -> None:
    """A network that knows rows only, on images that are turned upright."""
    trained, rgb = trained_network(TANGENT), _sphere(64)
    rotation = rotation_about((1, 2, 0), np.radians(40))
    upright = _predict(trained, InputImage(rgb)).mosaic.labels()
    tilted = InputImage(rotate_equirect(rgb, rotation), up=rotation @ [0, 0, 1])
    labels = _predict(trained, tilted).mosaic.labels()
    assert (labels == rotate_equirect(upright, rotation, "nearest")).mean() > 0.93
    with pytest.raises(SettingError, match=r"upright: found True.*base_level="):
        PanoramaPredictor(trained_network(ERP), Runner(trained), upright=True)


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
    rotations = turns(3, "rotations")
    assert rotations[0].tolist() == np.eye(3).tolist()
    for k, rotation in enumerate(rotations):
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
        turns(0, "rotations")
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
