"""A second place to learn from, deep inside any network, while training."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn

from models.stages import stage_channels
from tangent_train.errors import SettingError
from tangent_train.registry import registered

__all__ = ["AuxiliaryHead"]


@registered
class AuxiliaryHead(nn.Module):
    """Scores at an encoder stage beside those of the network, in training only.

    A 1×1 convolution on the features of the stage. It makes deep layers matter that a network with
    skip connections can do without for long; in evaluation and export it costs nothing.

    Args:
        network: Any module ``(B, C, h, w) -> scores``, a tensor or a mapping with one under
            ``"out"``.
        stage: Name of one of its submodules, whose result is features ``(B, C', h', w')``.
        in_channels: Channels C of the images, to find C' out.
        num_classes: Score planes, the unknown class 0 included.
        channels: C', where it cannot be found out.

    Raises:
        SettingError: A setting that cannot work; of stages, it names those there are.
    """

    def __init__(
        self,
        network: nn.Module,
        stage: str,
        in_channels: int | None = None,
        num_classes: int | None = None,
        channels: int | None = None,
    ) -> None:
        super().__init__()
        if num_classes is None:
            raise SettingError("network.num_classes", found="null", expected="how many there are")
        found = stage_channels(network, stage, in_channels, channels)
        self.network = network
        self.auxiliary_head = nn.Conv2d(found, num_classes, 1)
        self.stage = stage
        self._features: list[Tensor] | None = None
        network.get_submodule(stage).register_forward_hook(self._on_features)

    def forward(self, images: Tensor, *arguments: Any, **settings: Any) -> Any:
        """What the network returns; in training with the scores of the stage.

        Args:
            images: ``(B, C, h, w)``.
            *arguments: Of the network, passed on.
            **settings: Of the network, passed on.

        Returns:
            In training ``{"out": scores, "aux": (B, K, h', w')}``.

        Raises:
            SettingError: The stage was not reached, or the network has scores called ``"aux"``.
        """
        if not self.training:
            return self.network(images, *arguments, **settings)
        seen: list[Tensor] = []
        self._features = seen
        try:
            scores = self.network(images, *arguments, **settings)
        finally:
            self._features = None
        result = dict(scores) if isinstance(scores, Mapping) else {"out": scores}
        if not seen or "aux" in result:
            raise SettingError(
                "network.stage" if not seen else "network.network",
                found=self.stage if not seen else "one with scores called aux",
                expected="a stage that the network runs" if not seen else "one without",
            )
        # In chunks there is a part of each. Only now: what runs in a chunk is run again later.
        return {**result, "aux": self.auxiliary_head(torch.cat(seen))}

    def _on_features(self, _stage: nn.Module, _inputs: Any, features: Tensor) -> None:
        """The hook; without effect when the network is run by anyone else."""
        if self._features is not None:
            self._features.append(features)
