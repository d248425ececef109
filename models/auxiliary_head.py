"""Deep supervision: a second loss at a stage inside any network, in training only."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from typing import Any

from torch import Tensor, nn

from models.stages import stage_channels
from tangent_train.errors import SettingError
from tangent_train.registry import registered

__all__ = ["AuxiliaryHead"]


@registered
class AuxiliaryHead(nn.Module):
    """Scores at an encoder stage beside those of the network, in training only.

    A 1×1 convolution on the features of the stage. It trains deep layers that a network with
    skip connections otherwise learns to use only late; evaluation and export are not affected.

    Args:
        network: Any module ``(B, C, h, w) -> scores``, a tensor or a mapping with one under
            ``"out"``.
        stage: Name of a submodule, whose result is features ``(B, C', h', w')``.
        in_channels: Channels C of the images.
        num_classes: Classes K.

    Raises:
        SettingError: There is no such stage (the message lists the stages), or the network takes
            more than images.
    """

    def __init__(self, network: nn.Module, stage: str, in_channels: int, num_classes: int) -> None:
        super().__init__()
        if "rays" in inspect.signature(network.forward).parameters:
            raise SettingError(
                "network.network",
                found=type(network).__name__,
                expected="a network that takes nothing but images",
                remedy="Put the auxiliary head inside: SphereContext of AuxiliaryHead.",
            )
        self.network = network
        self.auxiliary_head = nn.Conv2d(stage_channels(network, stage, in_channels), num_classes, 1)
        self._features: Tensor | None = None
        network.get_submodule(stage).register_forward_hook(self._keep)

    def forward(self, images: Tensor) -> Any:
        """The network's result; in training ``{"out": scores, "aux": (B, K, h', w')}``.

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
