"""Evidence for up from a network that is confident only on upright images."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from datamodules.core.inputs import Normalization
from tangent_train.geometry import equirect_directions, random_rotation
from tangent_train.geometry.icosphere import icosphere_directions
from tangent_train.inference.engine import UpLikelihood
from tangent_train.inference.images import InputImage
from tests.inference.trained import ERP, ICOSPHERE, TANGENT, trained_network

if TYPE_CHECKING:
    from numpy.typing import NDArray

PLAIN = Normalization((0.5, 0.5, 0.5), (0.5, 0.5, 0.5))
AXES = np.concatenate([np.eye(3), -np.eye(3)])


class Sky(nn.Module):
    """Confident for bright pixels in the upper half of an image and dark ones in the lower half."""

    def __init__(self) -> None:
        super().__init__()
        self.shapes: set[tuple[int, ...]] = set()

    def forward(self, images: Tensor) -> Tensor:
        self.shapes.add(tuple(images.shape))
        upper = torch.arange(images.shape[2]) < images.shape[2] / 2
        fits = (images[:, 0] > 0) == upper[:, None]
        return torch.stack([30.0 * fits, 0.0 * fits], dim=1)


class SkyOfVertices(Sky):
    """The same, for a signal on the vertices of level 4: bright above the horizon."""

    def forward(self, images: Tensor) -> Tensor:
        self.shapes.add(tuple(images.shape))
        above = torch.from_numpy(icosphere_directions(4)[:, 2] > 0)
        fits = (images[:, 0] > 0) == above
        return torch.stack([30.0 * fits, 0.0 * fits], dim=1)


def _judge(network: Sky | None = None, **changes: Any) -> UpLikelihood:
    changes |= {
        "module": network or Sky(),
        "class_names": ("unknown", "up", "down"),
        "normalization": PLAIN,
    }
    return UpLikelihood(trained_network(TANGENT | {"level": 5}, **changes))


def _bright_above(up: NDArray[np.float64], height: int = 64) -> NDArray[np.uint8]:
    bright = equirect_directions((height, 2 * height)) @ up > 0
    return np.repeat(np.where(bright, 220, 30).astype(np.uint8)[..., None], 3, axis=-1)


@pytest.mark.parametrize("height", [64, 200])
def test_the_network_is_most_confident_on_upright_views(height: int) -> None:
    ups = AXES @ random_rotation(np.random.default_rng(height)).T
    judge = _judge()
    for true in range(6):
        likely = judge(InputImage(_bright_above(ups[true], height)), ups)
        assert likely.argmax() == true
        # Upside down nothing fits, and both classes are equally likely everywhere.
        assert likely.argmin() == (true + 3) % 6
        np.testing.assert_allclose(likely.min(), 12 * np.log(2), atol=0.4)
        # Lying on a side, two views see the border upright (half of each fits), two one color.
        others = np.delete(likely, [true, (true + 3) % 6])
        np.testing.assert_allclose(others, 12 * np.log(4), atol=0.4)


def test_networks_with_elevation_give_no_evidence() -> None:
    judge = _judge(inputs=("rgb", "elevation"))
    np.testing.assert_array_equal(judge(InputImage(_bright_above(AXES[1])), AXES), np.zeros(6))


@pytest.mark.parametrize(
    ("representation", "network", "size"),
    [(ICOSPHERE, SkyOfVertices(), (1, 2562)), (ERP, Sky(), (32, 64))],
)
def test_a_network_of_whole_spheres_gets_its_view_in_every_direction(
    representation: dict[str, Any], network: Sky, size: tuple[int, int]
) -> None:
    names = ("unknown", "up", "down")
    trained = trained_network(representation, module=network, class_names=names, fixed_size=size)
    judge = UpLikelihood(replace(trained, normalization=PLAIN))
    ups = AXES @ random_rotation(np.random.default_rng(1)).T
    for true in range(6):
        likely = judge(InputImage(_bright_above(ups[true])), ups)
        assert likely.argmax() == true
        assert likely.argmin() == (true + 3) % 6
    assert network.shapes == {(1, 3, *size)}
