"""Time the depth of a panorama, and its share outside the network."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np
import torch
from torch import Tensor, nn

from benchmarks.measuring import Alternative, Goal, Table, measure
from datamodules.core.inputs import Normalization
from datamodules.core.label_map import DISTANCE
from models import HuggingFaceDepthNetwork
from tangent_train.checkpoints.loaded import LoadedNetwork
from tangent_train.geometry import equirect_directions
from tangent_train.heads import head_of
from tangent_train.inference.engine import Predictor, views_per_forward
from tangent_train.inference.images import InputImage
from tangent_train.inference.views import ViewSelector, photo_network_settings


class RoomDepth(nn.Module):
    """Quick network: disparity is red, times a scale of each view that depends on green."""

    def forward(self, images: Tensor) -> Tensor:
        """Return disparity ``(B, 1, h, w)``."""
        return images[:, :1] * (1 + images[:, 1:2].mean(dim=(2, 3), keepdim=True))


def depth(quick: bool) -> Iterator[Table]:
    """Yield a table of the time of a network alone, and of everything else in a prediction.

    The network is Depth Anything V2 Small with random weights; its time is that of one call, times
    the number of calls. Everything else is the prediction with `RoomDepth`.
    """
    side, rows = (70, 64) if quick else (518, 1024)
    settings = photo_network_settings(side)
    trained = LoadedNetwork(
        module=RoomDepth(),
        predicts=DISTANCE,
        class_names=(),
        inputs=("rgb",),
        normalization=Normalization([0.0] * 3, [1.0] * 3),
        level=settings["level"],
        representation=settings,
        image_size=(side, side),
        photo_level=settings["level"],
        depth_kind="relative_disparity",
    )
    x, y, z = np.moveaxis(equirect_directions((rows, 2 * rows)), -1, 0)
    near = 1 / np.minimum.reduce([3 / np.abs(x), 2 / np.abs(y), 1.4 / np.abs(z)])
    rgb = np.stack([300 * near, 128 + 100 * y, 0 * z], axis=-1).astype(np.uint8)
    chosen = ViewSelector(trained)
    count = sum(map(len, chosen.representation.view_sets()))
    random = torch.rand(views_per_forward((side, side)), 3, side, side)
    network = HuggingFaceDepthNetwork({"model_type": "depth_anything"}).eval().requires_grad_(False)
    predict = partial(Predictor(trained, head_of(trained), chosen).predict, InputImage(rgb))
    name, calls = f"the network, {count} views", count / len(random)
    alternatives = [
        Alternative(name, partial(network, random), scale=calls, rounds=3),
        Alternative("everything else", lambda: predict().pixels(), is_ours=True),
    ]
    table = Table(f"depth: {2 * rows}×{rows}", measure(alternatives, 5))
    outside = table.ratio("everything else")
    share = 100 * outside / (1 + outside)
    table.goals = [Goal("outside the network, percent", share, 15)]
    yield table
