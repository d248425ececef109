"""Image sizes that a network accepts."""

from __future__ import annotations

import copy

import torch
from torch import Tensor, nn

__all__ = ["size_multiple_of"]

_PROBED = {
    1: (127, 131),
    2: (67, 71),
    4: (37, 41),
    8: (17, 19),
    14: (11, 13),
    16: (11, 13),
    32: (5, 7),
    64: (5, 7),
    128: (5, 7),
}
"""Candidate multiples, and the factors to try each with: primes, so that a tried side is a
multiple of nothing else. 14 is for transformers with such patches."""


def size_multiple_of(network: nn.Module, in_channels: int) -> int | None:
    """Find by trial the number that height and width must be multiples of.

    Args:
        network: In evaluation mode, on the CPU; its result a tensor.
        in_channels: Channels of its images.

    Returns:
        1, 2, 4, 8, 14, 16, 32, 64 or 128; None when it takes no such size.
    """
    found = None
    if any(True for _ in network.parameters()):  # none of an ONNX file
        shapes_only: nn.Module = copy.deepcopy(network).to("meta")
        found = _least_multiple(shapes_only, in_channels, "meta")
    # Some networks depend on values, which the meta device does not have.
    return found or _least_multiple(network, in_channels, "cpu")


def _least_multiple(network: nn.Module, in_channels: int, device: str) -> int | None:
    for multiple, counts in _PROBED.items():
        rows, columns = (multiple * count for count in counts)
        if _keeps_size(network, torch.zeros(1, in_channels, rows, columns, device=device)):
            return multiple
    return None


@torch.no_grad()
def _keeps_size(network: nn.Module, images: Tensor) -> bool:
    try:
        scores = network(images)
    except Exception:  # each network refuses sizes in its own words
        return False
    return tuple(scores.shape[-2:]) == tuple(images.shape[-2:])
