"""Deep supervision: a second loss at a stage inside any network, in training only."""

from __future__ import annotations

import copy
import inspect
from collections.abc import Mapping
from itertools import product
from typing import Any

import torch
from torch import Tensor, nn

from tangent_train.errors import SettingError

_TRIALS = list(product(("meta", "cpu"), (256, 224)))
"""Devices and sides of empty images to try: networks may depend on values, or have a fixed size."""

_LISTED_DEPTH = 2


def stage_channels(network: nn.Module, stage: str, in_channels: int) -> int:
    """Return the number of channels C' of the features ``(B, C', h', w')`` of a submodule.

    A copy of the network is run on an empty image, on torch's meta device where possible.

    Args:
        network: Network of images ``(B, C, h, w)``.
        stage: Name of a submodule that is run once per image.
        in_channels: Channels C of the images.

    Raises:
        SettingError: There is no such stage, or it does not return one feature map.
    """
    found: list[object] = []
    if stage in dict(network.named_modules()):
        for device, side in _TRIALS:
            found = []
            probe = copy.deepcopy(network).eval().to(device)
            probe.get_submodule(stage).register_forward_hook(
                lambda _module, _inputs, result, found=found: found.append(result)
            )
            try:
                with torch.no_grad():
                    probe(torch.zeros(1, in_channels, side, side, device=device))
                break
            except Exception:
                continue
    features = found[0] if len(found) == 1 else None
    if not isinstance(features, Tensor) or features.ndim != 4:
        names = [name.removeprefix("network.") for name, _ in network.named_modules() if name]
        shallow = [name for name in names if name.count(".") < _LISTED_DEPTH]
        raise SettingError(
            "network.stage",
            found=f"{stage!r} of {type(network).__name__}",
            expected="a submodule that is run once and returns one feature map (B, C, h, w)",
            remedy=f"There are: {', '.join(dict.fromkeys(shallow))}.",
        )
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
                remedy="Put the auxiliary head inside: a SphereContext of an AuxiliaryHead.",
            )
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
