"""`torch.compile` of a network that renders a panorama, predicts, and renders back."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor, nn

import tangent_train as tt
from tangent_train.geometry import rotation_about

# torch's own, where the graph breaks
pytestmark = pytest.mark.filterwarnings("ignore:The .grad attribute:UserWarning")


class Labeler(nn.Module):
    """A convolution of the tangent images of a batch of panoramas."""

    def __init__(self, grid: tt.TangentGrid, blend: Any) -> None:
        super().__init__()
        self.grid, self.blend = grid, blend
        self.layer = nn.Conv2d(3, 4, 3, padding=1)

    def forward(self, panoramas: Tensor) -> tuple[Tensor, Tensor]:
        images = tt.equirect_to_tangent(panoramas, self.grid)
        scores = self.layer(images.flatten(0, 1)).unflatten(0, images.shape[:2])
        back = tt.tangent_to_equirect(scores, self.grid, (32, 64), self.blend)
        return back, tt.tangent_to_labels(scores, self.grid, (32, 64), self.blend)


@pytest.mark.parametrize(("angle", "blend"), [(None, "feather"), (0.7, "nearest")])
def test_a_compiled_network_has_the_same_results_and_gradients(
    angle: float | None, blend: str
) -> None:
    """The panoramas are larger than the level: they are reduced too."""
    rotation = None if angle is None else rotation_about((0, 1, 0), angle)
    network = Labeler(tt.TangentGrid(0, 4, rotation=rotation), blend)
    compiled = torch.compile(network, backend="aot_eager")
    panoramas = torch.rand(2, 3, 64, 128, requires_grad=True)
    wanted = panoramas, *network.parameters()
    results = []
    for function in (network, compiled):
        back, labels = function(panoramas)
        results.append([back, labels, *torch.autograd.grad(back.square().mean(), wanted)])
    for found, expected in zip(*results, strict=True):
        torch.testing.assert_close(found, expected)


def test_a_compiled_network_follows_its_grid() -> None:
    """Another grid is not taken for the one that was compiled."""
    network = Labeler(tt.TangentGrid(0, 4), "nearest")
    compiled = torch.compile(network, backend="eager")
    panorama = torch.rand(1, 3, 32, 64)
    for grid in (network.grid, tt.TangentGrid(1, 4), tt.TangentGrid(0, 4, dim=20)):
        network.grid = grid
        torch.testing.assert_close(compiled(panorama), network(panorama))
