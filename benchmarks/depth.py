"""Time the depth of a panorama, and its share outside the network."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np
import torch
from torch import Tensor, nn

from benchmarks.measuring import Alternative, Goal, Table, measure
from datamodules.core.inputs import Normalization
from models import HuggingFaceDepthNetwork
from tangent_train.checkpoints.trained import TrainedNetwork
from tangent_train.geometry import equirect_directions
from tangent_train.inference.depth import DepthPredictor
from tangent_train.inference.engine import view_scores, views_per_forward
from tangent_train.inference.images import InputImage
from tangent_train.inference.representations import PanoramaViews, photo_network_settings


class RoomDepth(nn.Module):
    """The time of Depth Anything V2 Small with random weights, but other depth.

    Disparity is red, times a scale of each view that depends on green, so that there is something
    to align.
    """

    def __init__(self) -> None:
        super().__init__()
        self.network = HuggingFaceDepthNetwork({"model_type": "depth_anything"})

    def forward(self, images: Tensor) -> Tensor:
        """Return disparity ``(B, 1, h, w)``."""
        red, green = images[:, :1], images[:, 1:2].mean(dim=(2, 3), keepdim=True)
        return red * (1 + green) + 0 * self.network(images)


def depth(quick: bool) -> Iterator[Table]:
    """Yield a table of the time of the network alone, and of a whole prediction."""
    side, rows = (70, 64) if quick else (518, 1024)
    settings = photo_network_settings(side)
    trained = TrainedNetwork(
        RoomDepth().eval(),
        (),
        ("rgb",),
        Normalization([0.0] * 3, [1.0] * 3),
        settings["level"],
        settings,
        (side, side),
        photo_level=settings["level"],
        depth_kind="relative_disparity",
    )
    x, y, z = np.moveaxis(equirect_directions((rows, 2 * rows)), -1, 0)
    near = 1 / np.minimum.reduce([3 / np.abs(x), 2 / np.abs(y), 1.4 / np.abs(z)])
    rgb = np.stack([300 * near, 128 + 100 * y, 0 * z], axis=-1).astype(np.uint8)
    chosen = PanoramaViews(trained)
    count = sum(map(len, chosen.representation.view_sets()))
    random = torch.rand(count, 3, side, side)
    per_forward = views_per_forward((side, side))

    def network() -> None:
        for _ in view_scores(trained.network, random.__getitem__, count, per_forward):
            pass

    run = partial(DepthPredictor(trained, chosen).predict, InputImage(rgb))
    alternatives = [
        Alternative(f"the network, {count} views", network),
        Alternative("DepthPredictor", run, is_ours=True),
    ]
    table = Table(f"depth: {2 * rows}×{rows}", measure(alternatives, 2))
    outside = 100 * (1 - 1 / table.ratio("DepthPredictor"))
    table.goals = [Goal("outside the network, percent", outside, 15)]
    yield table
