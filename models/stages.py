"""Named stages inside networks: which there are, and how many channels their features have."""

from __future__ import annotations

import copy
from collections import Counter
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn

from models.held import HELD
from tangent_train.errors import SettingError

__all__ = ["stage_channels"]

_SIDES = (64, 224, 896)
"""Sides of the empty images that are tried: multiples of 64, of 14 and 32, of 128."""

_LISTED_DEPTH = 2
"""Of the names in messages, levels of modules."""


def stage_channels(
    network: nn.Module, stage: str, in_channels: int | None, channels: int | None = None
) -> int:
    """Channels of the features that a submodule of a network gives.

    They are found by running a copy of the network on an empty image, without computing anything
    where the network allows that.

    Args:
        network: Maps images ``(B, C, h, w)`` to anything.
        stage: Name of a submodule, whose result must be one tensor ``(B, C', h', w')``.
        in_channels: Channels C of the images; None only where `channels` is known.
        channels: Channels C' where they are known.

    Raises:
        SettingError: There is no such stage (it names those there are), it gives something else, or
            its channels cannot be found.
    """
    there = any(name == stage for name, _ in network.named_modules() if name)
    given = None if in_channels is None else _given(network, in_channels)
    if not there or (given is not None and stage not in given):
        raise SettingError(
            "network.stage",
            found=repr(stage)
            + (", which does not give one map of features once" if there else ", which is no part"),
            expected=f"a stage of {type(network).__name__}: {_listed(network, given)}",
        )
    found = channels if given is None else given[stage]
    if found is None:
        raise SettingError(
            "network.channels",
            found="null",
            expected=f"how many the features at {stage} have",
            remedy="They are only found out by themselves with network.in_channels, for a network "
            f"that takes images of {' or '.join(f'{side}×{side}' for side in _SIDES)} pixels.",
        )
    if channels not in (None, found):
        raise SettingError("network.channels", found=channels, expected=f"null, or {found}")
    return found


def _given(network: nn.Module, in_channels: int) -> dict[str, int] | None:
    """Channels of all stages that give features once, by name; None where no image could be run."""
    shapes_only = copy.deepcopy(network).eval().to("meta")
    for side in _SIDES:
        given = _seen(shapes_only, torch.zeros(1, in_channels, side, side, device="meta"))
        if given is not None:
            return given
    # Some networks look at values, which there are none of there.
    computing = copy.deepcopy(network).eval().to("cpu")
    return _seen(computing, torch.zeros(1, in_channels, _SIDES[1], _SIDES[1]))


@torch.no_grad()
def _seen(network: nn.Module, images: Tensor) -> dict[str, int] | None:
    channels: dict[str, int] = {}
    calls: Counter[str] = Counter()

    def look(name: str, _module: nn.Module, _inputs: Any, result: Any) -> None:
        calls[name] += 1
        if isinstance(result, Tensor) and result.ndim == images.ndim and len(result) == 1:
            channels[name] = result.shape[1]

    modules = [(name, module) for name, module in network.named_modules() if name]
    handles = [module.register_forward_hook(partial(look, name)) for name, module in modules]
    try:
        network(images)
    except Exception:  # each network refuses images in its own words
        return None
    finally:
        for handle in handles:
            handle.remove()
    return {name: count for name, count in channels.items() if calls[name] == 1}


def _listed(network: nn.Module, given: dict[str, int] | None) -> str:
    names = [name for name, _ in network.named_modules()] if given is None else list(given)
    depths = {name: sum(part != HELD for part in name.split(".")) for name in names if name}
    return ", ".join(name for name, depth in depths.items() if 1 <= depth <= _LISTED_DEPTH)
