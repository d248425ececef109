"""Outputs of any network: scores of classes, or depth."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor, nn

from tangent_train.checkpoints.outputs import OutputNetwork, as_logits
from tangent_train.kinds import ScoreKind


class LabelMaps(nn.Module):
    """A network that returns the class of a pixel, which is its red channel, and no scores."""

    def forward(self, images: Tensor) -> Tensor:
        return images[:, 0]


def test_label_maps_are_certain() -> None:
    """Other values are in the last group."""
    images = torch.tensor([0.0, 2.0, 1.0, -1.0, 3.0, 255.0, torch.nan]).expand(1, 3, 2, 7)
    scores = OutputNetwork(LabelMaps(), 3, [[0], [1], [2], [3]], kind="labels")(images)
    assert scores.argmax(dim=1).tolist() == [[[0, 2, 1, 3, 3, 3, 3]] * 2]
    assert float(scores.softmax(dim=1).amax(dim=1).min()) > 0.999


@pytest.mark.parametrize("kind", ["logits", "probabilities"])
def test_a_single_score_is_that_of_a_sigmoid(kind: ScoreKind) -> None:
    logits = torch.linspace(-3, 3, 6).reshape(1, 1, 2, 3)
    returned = logits.sigmoid() if kind == "probabilities" else logits
    found = as_logits(returned, kind, 1).softmax(dim=1)
    torch.testing.assert_close(found[:, :1], logits.sigmoid())


@pytest.mark.parametrize("size", [(4, 6), (5, 6), (11, 13)])
def test_larger_images_are_divided(size: tuple[int, int]) -> None:
    """A network of single pixels: dividing changes nothing, and every part has the right size."""
    network, images = nn.Conv2d(3, 2, 1), torch.randn(2, 3, *size)
    expected, seen = network(images), []
    network.register_forward_pre_hook(lambda _, given: seen.append(given[0].shape[-2:]))
    with torch.no_grad():
        found = OutputNetwork(network, 2, tile=(4, 6))(images)
    torch.testing.assert_close(found, expected.detach())
    assert set(seen) == {(4, 6)}
    assert len(seen) == -(-size[0] // 4) * -(-size[1] // 6)


class _MeanColor(nn.Module):
    """Depth is the mean of the channels, of images of one size."""

    def __init__(self, output: str) -> None:
        super().__init__()
        self.output = output

    def forward(self, images: Tensor) -> Any:
        assert images.shape[-2:] == (4, 6)
        depth = images.mean(dim=1)
        channel = depth[:, None]
        return {"map": depth, "channel": channel, "dict": {"out": channel}}[self.output]


@pytest.mark.parametrize("output", ["map", "channel", "dict"])
def test_depth_has_one_channel_and_images_are_resized_for_it(output: str) -> None:
    """A plane keeps its depth: no part of the image is predicted separately."""
    network = OutputNetwork(_MeanColor(output), 1, tile=(4, 6), kind=None)
    images = torch.randn(2, 3, 4, 6)
    torch.testing.assert_close(network(images), images.mean(dim=1, keepdim=True))
    x, y = torch.meshgrid(torch.linspace(-1, 1, 12), torch.linspace(-1, 1, 8), indexing="xy")
    images = (2 + 0.5 * x + y).expand(1, 3, 8, 12)
    found = network(images)
    assert found.shape == (1, 1, 8, 12)
    torch.testing.assert_close(found[..., 1:-1, 1:-1], images[:, :1, 1:-1, 1:-1], atol=0.1, rtol=0)


@pytest.mark.parametrize("wrong", [torch.nan, torch.inf, -torch.inf])
@pytest.mark.parametrize("kind", ["logits", "probabilities"])
def test_a_single_score_and_probabilities_that_are_not_finite_are_nan(
    kind: ScoreKind, wrong: float
) -> None:
    for count in (1, 3):
        scores = torch.full((1, count, 1, 2), 0.25)
        scores[..., 1] = wrong
        largest = as_logits(scores, kind, count).amax(dim=1)[0, 0]
        assert largest.isfinite().tolist() == [True, False]
