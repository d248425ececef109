"""Convert the output of networks to scores of classes at every pixel."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from models.distortion_aware import make_distortion_aware
from tangent_train.checkpoints.kinds import ScoreKind
from tangent_train.errors import SettingError, width_height

_LABEL_MAP = 3
"""Number of dimensions of label maps without an axis of scores."""

_CERTAIN = 20.0
"""Score of a pixel's class if the network returns labels."""

Groups = Sequence[Sequence[int]]
"""Indices of the scores of each class, whose probabilities are added up."""


class ClassScoreNetwork(nn.Module):
    """A network whose output is converted to the scores of classes.

    Args:
        network: Network that maps images ``(B, C, h, w)`` to scores ``(B, K, h, w)``, to a dict
            with these under ``"out"`` (as in torchvision), or to label maps.
        num_classes: Number K of classes.
        groups: Indices of the network's scores for each class, including index K of kinds that
            have it. Scores in no group, and classes without scores, never win. None if each score
            is a class.
        tile: Rows and columns of the only image size that the network takes; larger images are
            divided. None if it takes other sizes.
        kind: Kind of the network's output.

    Attributes:
        num_scores: Number of scores of a pixel: K, or the number of groups.
        tile: See above.
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
        self.tile = tile
        self._kind = kind

    def forward(self, images: Tensor, *arguments: Any, **settings: Any) -> Tensor:
        """Return the scores ``(B, num_scores, h, w)``.

        Args:
            images: Normalized images ``(B, C, h, w)``.
            *arguments: Further arguments of the network.
            **settings: Further arguments of the network, by name.

        Raises:
            SettingError: The network returns another number of scores.
        """
        size = (images.shape[-2], images.shape[-1])
        if self.tile in (None, size):
            return self._class_scores(images, *arguments, **settings)
        return _tiled_scores(self._class_scores, images, self.tile)

    def _class_scores(self, images: Tensor, *arguments: Any, **settings: Any) -> Tensor:
        returned = self.network(images, *arguments, **settings)
        groups = self._groups
        needed = self.num_scores if groups is None else 1 + max(k for g in groups for k in g)
        scores = as_logits(plain_scores(returned), self._kind, needed - 1)
        count = scores.shape[1]
        if count < needed or (groups is None and count > needed):
            raise SettingError(
                "class names of the network",
                found=f"{self.num_scores}, for {count} scores",
                expected="one name for each score",
            )
        if groups is None:
            return scores
        return torch.cat([_sum(scores, group) for group in groups], dim=1)


def network_for_views(network: nn.Module, distortion_aware: bool | None) -> nn.Module:
    """Return a network as it is applied to views: distortion-aware if they are.

    Args:
        network: The network, see `make_distortion_aware`.
        distortion_aware: Setting of the representation; None if it has no such setting.

    Raises:
        SettingError: The convolutions cannot be sampled on the sphere.
    """
    if not distortion_aware:
        return network
    tile = getattr(network, "tile", None)
    if tile is not None:
        raise SettingError(
            "distortion-aware convolutions",
            found=f"a network that takes only images of {width_height(tile)}",
            expected="one that takes whole equirectangular images",
            remedy="Import the network from torch, without image_size=.",
        )
    return make_distortion_aware(network)


def plain_scores(returned: Any) -> Tensor:
    """Return scores or label maps from a network's output, which is a dict in torchvision."""
    scores: Tensor = returned["out"] if isinstance(returned, dict) else returned
    return scores


def as_logits(scores: Tensor, kind: ScoreKind, num_labels: int) -> Tensor:
    """Convert scores so that their softmax is the probability of each class.

    Args:
        scores: Scores ``(B, K, h, w)`` or label maps.
        kind: Kind of the scores.
        num_labels: Number K of labels in label maps.

    Returns:
        Scores ``(B, K, h, w)``; ``(B, K + 1, h, w)`` for label maps and for a single score, see
        `ScoreKind`.
    """
    if kind == "labels":
        values = scores if scores.ndim == _LABEL_MAP else scores[:, 0]
        known = (values >= 0) & (values < num_labels)  # False for NaN
        labels = torch.where(known, values.long(), num_labels)
        return functional.one_hot(labels, num_labels + 1).movedim(-1, 1) * _CERTAIN
    if scores.shape[1] == 1:
        limit = torch.finfo(scores.dtype).eps
        logits = scores.logit(limit) if kind == "probabilities" else scores
        return torch.cat([logits, torch.zeros_like(logits)], dim=1)
    if kind == "probabilities":
        return scores.clamp_min(torch.finfo(scores.dtype).tiny).log()
    return scores


def _sum(scores: Tensor, group: Sequence[int]) -> Tensor:
    """Return the logarithm of a sum of probabilities, up to a constant of the pixel."""
    if not group:
        # Less than all others at every pixel, and so in means over pixels. Not minus infinity,
        # which becomes NaN when it is weighted by 0.
        return scores.amin(1, keepdim=True) - _CERTAIN
    chosen = scores[:, list(group)]
    return chosen if len(group) == 1 else chosen.logsumexp(1, keepdim=True)


def _tiled_scores(network: Any, images: Tensor, tile: tuple[int, int]) -> Tensor:
    """Return the mean scores of evenly spaced tiles that cover larger images."""
    starts = [
        torch.linspace(0, side - part, -(-side // part)).round().int().tolist()
        for side, part in zip(images.shape[-2:], tile, strict=True)
    ]
    total: Any = 0
    count = images.new_zeros(images.shape[-2:])
    for top in starts[0]:
        for left in starts[1]:
            area = (..., slice(top, top + tile[0]), slice(left, left + tile[1]))
            scores = network(images[area])
            if not count.any():
                total = scores.new_zeros(*scores.shape[:2], *images.shape[-2:])
            total[area] += scores
            count[area] += 1
    result: Tensor = total / count
    return result
