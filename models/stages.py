"""The channels of the features at a named stage inside a network."""

from __future__ import annotations

import copy
from itertools import product

import torch
from torch import Tensor, nn

from tangent_train.errors import SettingError

__all__ = ["stage_channels"]

_TRIALS = list(product(("meta", "cpu"), (256, 224)))
"""Devices and sides of the empty images: some networks depend on values, some fix their input."""

_LISTED_DEPTH = 2


def stage_channels(network: nn.Module, stage: str, in_channels: int) -> int:
    """Channels C' of the features ``(B, C', h', w')`` that a submodule returns.

    A copy of the network is run on an empty image, on torch's meta device where possible.

    Args:
        network: Maps images ``(B, C, h, w)`` to anything.
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
