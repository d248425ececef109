from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from tangent_train.results.html import EncodedImage, encode_image
from tangent_train.results.html.page import BUDGET_BYTES
from tests.decoded import decoded

CLASSES = 14
NAMES = tuple(f"class {k}" for k in range(CLASSES))


def _noise(height: int, budget: int = BUDGET_BYTES) -> tuple[NDArray[np.uint8], EncodedImage]:
    """The truth of an image of noise, and the image."""
    rng = np.random.default_rng(0)
    shape = (height, 2 * height)
    truth, prediction = rng.integers(0, CLASSES, (2, *shape), np.uint8)
    rgb = rng.integers(0, 256, (*shape, 3), np.uint8)
    return truth, encode_image(
        "noise", rgb, CLASSES, prediction=prediction, truth=truth, budget_bytes=budget
    )


@pytest.mark.parametrize("budget", [150_000, 400_000])
def test_noisy_labels_are_halved_and_the_picture_made_coarser_until_they_fit(budget: int) -> None:
    truth, image = _noise(512, budget)
    assert _base64_size(image) <= budget
    labels = decoded(image.truth)
    factor = 512 // len(labels)
    assert factor > 1
    # Nearest: every label is one of those below it, no mixture.
    blocks = truth.reshape(len(labels), factor, len(labels) * 2, factor)
    assert np.all((blocks == labels[:, None, :, None]).any(axis=(1, 3)))


def _base64_size(image: EncodedImage) -> int:
    files = (image.input, image.thumbnail, image.truth or b"", image.prediction or b"")
    return sum(-(-len(file) // 3) * 4 for file in files)


def test_a_larger_image_is_shrunk_by_area_and_its_labels_to_the_nearest() -> None:
    rgb = np.zeros((256, 8192, 3), np.uint8)
    rgb[:, 1::2] = 200  # stripes of one pixel: only their mean may be left
    labels = np.zeros((256, 8192), np.uint8)
    labels[100:200, 2000:5000] = 7
    image = encode_image("large", rgb, CLASSES, prediction=labels, sphere=False)
    assert (image.width, image.height) == (8192, 256)
    shrunk = decoded(image.input)
    assert shrunk.shape == (128, 4096, 3)
    assert np.abs(shrunk.astype(int) - 100).max() <= 2
    np.testing.assert_array_equal(decoded(image.prediction)[50:100, 1000:2500], 7)
    assert np.count_nonzero(decoded(image.prediction)) == 50 * 1500


def test_shares_are_of_the_solid_angle_on_panoramas_and_of_the_pixels_on_photos() -> None:
    labels = np.ones((90, 180), np.uint8)
    labels[:15] = 2  # the cap above 60°: (1 - sin 60°) / 2 of the sphere, 1/6 of the pixels
    rgb = np.zeros((90, 180, 3), np.uint8)
    cap = (1 - np.sin(np.radians(60))) / 2
    for sphere, share in ((True, cap), (False, 1 / 6)):
        image = encode_image("", rgb, CLASSES, prediction=labels, truth=labels, sphere=sphere)
        expected = [(1, 1 - share, 1 - share), (2, share, share)]
        np.testing.assert_allclose(image.shares, expected, atol=1e-12)
