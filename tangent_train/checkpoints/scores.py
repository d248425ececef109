"""The scores of any network as those of its classes, at every pixel of the image."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from contextlib import suppress
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from tangent_train.checkpoints.content import ScoreKind
from tangent_train.errors import SettingError

_LABEL_MAP = 3
"""Dimensions of label maps without an axis of scores."""

_CERTAIN = 20.0
"""Score of a pixel's class where the network gives nothing but labels."""

Groups = Sequence[Sequence[int]]
"""For every class, the scores whose probabilities add up to that of the class."""


class ClassScoreNetwork(nn.Module):
    """A network whose result is the score of every class.

    Args:
        network: Maps images ``(B, C, h, w)`` to scores ``(B, K, h, w)``, to a dict with those under
            ``"out"`` (torchvision's), or to label maps.
        num_classes: K.
        groups: The network's scores that make up each class; scores in no group never win, nor do
            classes without scores.
        tile: Rows and columns of the only images that the network takes: larger ones are divided.
        kind: Output of the network; groups contain the place K of kinds that have it.

    Attributes:
        num_scores: Scores of a pixel: K, or the number of groups.
    """

    def __init__(
        self,
        network: nn.Module,
        num_classes: int,
        groups: Groups | None = None,
        tile: tuple[int, int] | None = None,
        kind: ScoreKind = "logits",
    ) -> None:
        super().__init__()
        self.network = network
        self.num_scores = num_classes if groups is None else len(groups)
        self._groups = groups
        self._tile = tile
        self._kind = kind

    def forward(self, images: Tensor, *arguments: Any, **settings: Any) -> Tensor:
        """Scores ``(B, num_scores, h, w)``.

        Args:
            images: ``(B, C, h, w)``, normalized.
            *arguments: For the network.
            **settings: For the network.

        Raises:
            SettingError: The network has another number of scores.
        """
        size = (images.shape[-2], images.shape[-1])
        if self._tile in (None, size):
            return self._of(images, *arguments, **settings)
        return _tiled(self._of, images, self._tile)

    def _of(self, images: Tensor, *arguments: Any, **settings: Any) -> Tensor:
        returned = self.network(images, *arguments, **settings)
        groups = self._groups
        needed = self.num_scores if groups is None else 1 + max(k for g in groups for k in g)
        scores = as_logits(plain_scores(returned), self._kind, needed - 1)
        count = scores.shape[1]
        if count < needed or (groups is None and count > needed):
            raise SettingError(
                "class names of the network",
                found=f"{self.num_scores}, for {count} scores",
                expected="one for every score",
            )
        if groups is None:
            return scores
        return torch.cat([_sum(scores, group) for group in groups], dim=1)


def plain_scores(returned: Any) -> Tensor:
    """Scores or label maps that a network returned, which torchvision's keep in a dict."""
    scores: Tensor = returned["out"] if isinstance(returned, dict) else returned
    return scores


def as_logits(scores: Tensor, kind: ScoreKind, num_labels: int) -> Tensor:
    """Scores whose softmax is the probability of every class.

    Args:
        scores: Scores ``(B, K, h, w)`` or label maps.
        kind: See `ScoreKind`.
        num_labels: K of label maps.

    Returns:
        ``(B, K, h, w)``, or ``(B, K + 1, h, w)`` of the kinds with a place K.
    """
    if kind == "labels":
        values = scores if scores.ndim == _LABEL_MAP else scores[:, 0]
        known = (values >= 0) & (values < num_labels)  # never true of NaN
        labels = torch.where(known, values.long(), num_labels)
        return functional.one_hot(labels, num_labels + 1).movedim(-1, 1) * _CERTAIN
    if kind == "probabilities":
        return scores.clamp_min(torch.finfo(scores.dtype).tiny).log()
    if kind == "logits":
        return scores
    if kind == "sigmoid":
        scores = scores.logit(torch.finfo(scores.dtype).eps)
    return torch.cat([scores, torch.zeros_like(scores[:, :1])], dim=1)


def _sum(scores: Tensor, group: Sequence[int]) -> Tensor:
    """The logarithm of a sum of probabilities, up to what all classes of a pixel share."""
    if not group:
        # Below all others at every pixel, and so in every mean of pixels. Not minus infinity, which
        # is not a number when it is weighted by 0.
        return scores.amin(1, keepdim=True) - _CERTAIN
    chosen = scores[:, list(group)]
    return chosen if len(group) == 1 else chosen.logsumexp(1, keepdim=True)


def _tiled(network: Any, images: Tensor, tile: tuple[int, int]) -> Tensor:
    """The mean scores of the evenly spaced tiles that cover larger images."""
    starts = [
        torch.linspace(0, side - part, -(-side // part)).round().int().tolist()
        for side, part in zip(images.shape[-2:], tile, strict=True)
    ]
    total: Any = 0
    count = images.new_zeros(images.shape[-2:])
    for top in starts[0]:
        for left in starts[1]:
            place = (..., slice(top, top + tile[0]), slice(left, left + tile[1]))
            scores = network(images[place])
            if not count.any():
                total = scores.new_zeros(*scores.shape[:2], *images.shape[-2:])
            total[place] += scores
            count[place] += 1
    result: Tensor = total / count
    return result


_PROBED = {1: (127, 131), 2: (67, 71), 4: (37, 41), 8: (17, 19), 14: (11, 13), 16: (11, 13)}
_PROBED |= dict.fromkeys((32, 64, 128), (5, 7))
"""Candidate multiples, and the factors to try each with: primes, so that a tried side is a
multiple of nothing else. 14 is for transformers with such patches."""


def size_multiple_of(network: nn.Module, in_channels: int) -> int | None:
    """Find by trial the number that height and width must be multiples of.

    Args:
        network: Network in evaluation mode on the CPU that returns a tensor.
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


@torch.no_grad()
def _least_multiple(network: nn.Module, in_channels: int, device: str) -> int | None:
    for multiple, counts in _PROBED.items():
        size = torch.Size(multiple * count for count in counts)
        with suppress(Exception):  # each network refuses sizes in its own words
            scores = network(torch.zeros(1, in_channels, *size, device=device))
            if scores.shape[-2:] == size:
                return multiple
    return None
