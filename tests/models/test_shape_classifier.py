from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import nn

from models import ShapeClassifier
from tangent_train.errors import SettingError
from tests.tasks.small_networks import with_statistics

Array = NDArray[np.float64]


@pytest.mark.parametrize(
    ("classes", "width", "parameters"),
    [(40, 16, 1_309_976), (40, 32, 5_135_880), (10, 16, 1_309_976 - 30 * (64 * 16 + 1))],
)
def test_parameters_are_those_of_the_released_code(
    classes: int, width: int, parameters: int
) -> None:
    network = ShapeClassifier(6, classes, width)
    assert sum(p.numel() for p in network.parameters() if p.requires_grad) == parameters


def _convolved(x: Array, layer: dict[str, Array], stride: int = 1) -> Array:
    """``(C, h, w)`` by loops over the taps, padded so that a stride of 1 keeps the size."""
    weight = layer["weight"]
    size = weight.shape[-1]
    pad = size // 2
    padded = np.pad(x, ((0, 0), (pad, pad), (pad, pad)))
    rows, columns = x.shape[1] // stride, x.shape[2] // stride
    result = np.zeros((len(weight), rows, columns)) + layer["bias"][:, None, None]
    for i in range(size):
        for j in range(size):
            taps = padded[:, i::stride, j::stride][:, :rows, :columns]
            result += np.einsum("oc,chw->ohw", weight[:, :, i, j], taps)
    return result


def _normalized(x: Array, layer: dict[str, Array]) -> Array:
    scale = layer["weight"] / np.sqrt(layer["running_var"] + 1e-5)
    shift = layer["bias"] - layer["running_mean"] * scale
    return x * scale[:, None, None] + shift[:, None, None]


def _halved(x: Array) -> Array:
    """Bilinear at half the size: what the released code does after a convolution."""
    return (x[:, ::2, ::2] + x[:, 1::2, ::2] + x[:, ::2, 1::2] + x[:, 1::2, 1::2]) / 4


def _block(x: Array, layers: dict[str, dict[str, Array]]) -> Array:
    """A residual block in the order of the released code: halved after the 1×1 convolutions."""
    y = _halved(_convolved(x, layers["body.0"]))
    y = np.maximum(_normalized(y, layers["body.1"]), 0)
    y = np.maximum(_normalized(_convolved(y, layers["body.3"]), layers["body.4"]), 0)
    y = _normalized(_convolved(y, layers["body.6"]), layers["body.7"])
    shortcut = _normalized(_halved(_convolved(x, layers["shortcut.0"])), layers["shortcut.1"])
    return np.maximum(y + shortcut, 0)


def _layers(network: nn.Module, prefix: str) -> dict[str, dict[str, Array]]:
    found: dict[str, dict[str, Array]] = {}
    for name, tensor in network.state_dict().items():
        if name.startswith(prefix):
            layer, _, kind = name.removeprefix(prefix).rpartition(".")
            found.setdefault(layer, {})[kind] = tensor.double().numpy()
    return found


def _by_hand(network: ShapeClassifier, images: Array) -> Array:
    """Scores of one shape ``(N, C, h, w)`` in float64."""
    stem = _layers(network, "features.")
    total, positions = np.zeros(0), 0
    for image in images:
        x = _convolved(image, stem["0"], stride=2)
        x = np.maximum(_normalized(x, stem["1"]), 0)
        for block in (3, 4, 5):
            x = _block(x, _layers(network, f"features.{block}.1."))
        total = total + x.sum(axis=(1, 2)) if len(total) else x.sum(axis=(1, 2))
        positions += x.shape[1] * x.shape[2]
    head = _layers(network, "head.")[""]
    scores: Array = head["weight"] @ (total / positions) + head["bias"]
    return scores


@pytest.mark.parametrize("shape", [(2, 3, 6, 32, 32), (1, 2, 6, 16, 48)])
def test_scores_equal_those_computed_by_hand(shape: tuple[int, ...]) -> None:
    torch.manual_seed(0)
    network: Any = with_statistics(ShapeClassifier(6, 5, 4)).eval()
    images = torch.randn(shape)
    with torch.no_grad():
        found = network(images)
    expected = [_by_hand(network, shape_images) for shape_images in images.double().numpy()]
    np.testing.assert_allclose(found.numpy(), expected, rtol=1e-4, atol=1e-5)


def test_dropout_is_of_training_only() -> None:
    torch.manual_seed(0)
    images = torch.randn(2, 3, 6, 16, 16)
    network = ShapeClassifier(6, 4, 2)
    assert not torch.equal(network(images), network(images))
    none = ShapeClassifier(6, 4, 2, dropout=0.0)
    assert torch.equal(none(images), none(images))


def test_images_that_do_not_fit_are_refused() -> None:
    message = r"image size for the ShapeClassifier: found 24×32; expected .* multiples of 16"
    with pytest.raises(SettingError, match=message):
        ShapeClassifier(6, 4, 2)(torch.zeros(1, 2, 6, 24, 32))
