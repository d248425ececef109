"""What a photo network returns, found by trying it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from math import nan
from typing import get_args

import numpy as np
import torch
from torch import Tensor

from tangent_train.checkpoints.content import ScoreKind
from tangent_train.checkpoints.scores import plain_scores
from tangent_train.errors import SettingError, width_height
from tangent_train.inference.photo_networks.network import PhotoNetwork

_LISTED = 9
"""Labels in a message."""

_VOID = -1
"""The only negative value in label maps."""

_ROUNDED = 2e-3
"""Relative error of sums of probabilities in float16."""

_WILD = 30.0
"""Standard deviation of an image that drives scores far from 0 and 1."""

_CERTAIN = ("logits", "sigmoid_logits")
"""Kinds that no further image makes another one."""

_OF_ONE_SCORE: dict[ScoreKind, ScoreKind] = {
    "logits": "sigmoid_logits",
    "probabilities": "sigmoid",
}
"""A softmax over one score is always 1, so that its networks end in a sigmoid."""


@torch.no_grad()
def try_network(network: PhotoNetwork) -> tuple[ScoreKind, int]:
    """The kind of a network's scores and their number K, 1 of label maps.

    The kind is the one that the user or the network's library states. Else the network sees up to
    four images, for one alone may mislead:

    * One score: whole numbers are labels, numbers from 0 to 1 come from a sigmoid, and numbers
      of both signs go into one.
    * More scores: positive ones with the same sum at every pixel come from a softmax, others from
      0 to 1 from sigmoids.

    Args:
        network: The network; in evaluation mode afterwards.

    Raises:
        SettingError: The network does not take RGB images of its size, or its scores fit no kind.
    """
    network.network.eval()
    kind = network.score_kind
    pixels = torch.empty(0)
    for image in _images(network):
        scores = _scores(network, image).movedim(1, 0).flatten(1)
        pixels = torch.cat([pixels, scores], dim=1) if len(pixels) else scores
        if network.score_kind is None:
            kind = _kind_of(pixels)
        if kind in _CERTAIN or network.score_kind not in (None, "labels"):
            break
    count = len(pixels)
    least, most = pixels.amin().item(), pixels.amax().item()
    if kind is None:
        raise SettingError(
            "scores",
            found=f"{count} per pixel, from {least:g} to {most:g}",
            expected=f"of a kind that can be recognized: {', '.join(get_args(ScoreKind))}",
            remedy="Name it: scores=logits for a network whose last step, a softmax or a sigmoid, "
            "is missing; scores=probabilities for one that ends in it.",
        )
    if kind == "labels":
        found = np.unique(pixels.nan_to_num(_VOID).numpy())
        _check_labels(found.tolist(), len(network.score_names))
    kind = _OF_ONE_SCORE.get(kind, kind) if count == 1 else kind
    if kind in ("sigmoid", "probabilities") and (least < 0 or (most > 1 and kind == "sigmoid")):
        raise SettingError(
            "scores",
            found=f"{kind}, but numbers from {least:g} to {most:g}",
            expected="probabilities from 0 to 1",
        )
    return kind, count


def _images(network: PhotoNetwork) -> Iterator[Tensor]:
    """Black, white, noise, and noise beyond all colors, normalized."""
    mean, std = (
        torch.tensor(values, dtype=torch.float32)[:, None, None]
        for values in (network.normalization.mean, network.normalization.std)
    )
    generator = torch.Generator().manual_seed(0)
    shape = (1, 3, *network.image_size)
    for image in (torch.zeros(shape), torch.ones(shape), torch.rand(shape, generator=generator)):
        yield (image - mean) / std
    yield _WILD * torch.randn(shape, generator=generator)


def _scores(network: PhotoNetwork, image: Tensor) -> Tensor:
    """Scores ``(1, K, h, w)`` as float32, label maps with K = 1."""
    try:
        scores = plain_scores(network.network(image))
    except Exception as error:  # each network refuses images in its own words
        raise SettingError(
            "image_size",
            found=f"{width_height(image.shape[2:])}, which the network does not take "
            f"({type(error).__name__}: {str(error).partition(chr(10))[0]})",
            expected="the size of its RGB images",
            remedy="Set image_size=[rows,columns]. Networks for other images cannot be imported.",
        ) from error
    scores = scores[:, None] if scores.ndim == image.ndim - 1 else scores
    if scores.shape[0] != 1 or scores.shape[2:] != image.shape[2:]:
        rows, columns = image.shape[2:]
        raise SettingError(
            "output of the network",
            found=tuple(scores.shape),
            expected=f"scores (1, K, {rows}, {columns}) or labels (1, {rows}, {columns})",
        )
    return scores.float()


def _check_labels(found: Sequence[float], named: int) -> None:
    """Refuse other labels than the named ones, beyond which only void has a value, e.g. 255."""
    known = max(2, named)  # those of one class are 0, its background, and 1
    others = 0 not in found or (1 not in found and max(found) > 1)
    if known in found or (named == 1 and others):
        raise SettingError(
            "class names of the network",
            found=f"{named}, for labels {', '.join(f'{label:g}' for label in found[:_LISTED])}",
            expected="a name for every label; one name is that of label 1, beside a background 0",
            remedy="Name the others too, and set nothing= to the names of those that mean nothing.",
        )


def _kind_of(scores: Tensor) -> ScoreKind | None:
    """The kind of the scores ``(K, pixels)`` of some images; None if they fit none."""
    whole = bool(((scores == scores.round()) | scores.isnan()).all())
    scores = scores[:, scores.isfinite().all(dim=0)]
    least, most = (scores.amin().item(), scores.amax().item()) if scores.numel() else (nan, nan)
    within = least >= 0 and most <= 1
    if len(scores) == 1:
        if whole and least >= _VOID:
            return "labels"
        if within:
            return "sigmoid"
        if least < 0 < most:
            return "sigmoid_logits"
    else:
        sums = scores.sum(dim=0)
        even = (sums - sums.mean()).abs().max() <= _ROUNDED * sums.mean()
        if least >= 0 and even and most > least:
            return "probabilities"
        if within and most > least:
            return "sigmoid"
        if least < 0 or not whole:
            return "logits"
    return None
