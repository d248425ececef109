"""Deep supervision of a stage of any network."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn

_SIDE = 256
"""Side of the empty image that is used to find the number of channels."""


def stage_channels(network: nn.Module, stage: str, in_channels: int) -> int:
    """Return the number of channels C' of the features ``(B, C', h', w')`` of a submodule.

    A copy of the network is run on an empty image.

    Args:
        network: Network of images ``(B, C, h, w)``.
        stage: Name of a submodule that is run once per image.
        in_channels: Channels C of the images.
    """
    found: list[Tensor] = []
    probe = copy.deepcopy(network).eval()
    probe.get_submodule(stage).register_forward_hook(lambda *given: found.append(given[2]))
    with torch.no_grad():
        probe(torch.zeros(1, in_channels, _SIDE, _SIDE))
    (features,) = found
    return features.shape[1]


class AuxiliaryHead(nn.Module):
    """Adds scores at an encoder stage to those of the network, in training only.

    A 1×1 convolution on the features of the stage. It trains deep layers, which a
    network with skip connections otherwise starts to use late. Evaluation and export do not change.

    Args:
        network: Any module ``(B, C, h, w) -> scores``, a tensor or a mapping with one under
            ``"out"``.
        stage: Name of a submodule, whose result is features ``(B, C', h', w')``.
        in_channels: Channels C of the images.
        num_classes: Classes K.
    """

    def __init__(self, network: nn.Module, stage: str, in_channels: int, num_classes: int) -> None:
        super().__init__()
        self.network = network
        self.auxiliary_head = nn.Conv2d(stage_channels(network, stage, in_channels), num_classes, 1)
        self._features: Tensor | None = None
        network.get_submodule(stage).register_forward_hook(self._keep)

    def forward(self, images: Tensor) -> Any:
        """Return the network's result; in training ``{"out": scores, "aux": (B, K, h', w')}``.

        Args:
            images: ``(B, C, h, w)``.
        """
        scores = self.network(images)
        features, self._features = self._features, None
        if features is None:
            return scores
        named = scores if isinstance(scores, Mapping) else {"out": scores}
        return {**named, "aux": self.auxiliary_head(features)}

    def _keep(self, _stage: nn.Module, _inputs: Any, features: Tensor) -> None:
        self._features = features if self.training else None
