"""Find by trial which kind of scores a photo network returns."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import get_args

import numpy as np
import torch
from torch import Tensor

from tangent_train.checkpoints.kinds import ScoreKind
from tangent_train.checkpoints.scores import plain_scores
from tangent_train.errors import SettingError, first_line, width_height
from tangent_train.photo_networks.network import PhotoNetwork

_MASK_NAMES = 2
"""Largest number of names for a class and its background."""

_LISTED = 9
"""Largest number of labels in a message."""

_VOID = -1
"""Value that replaces NaN in label maps."""

_ROUNDED = 2e-3
"""Relative error of sums of probabilities in float16."""

_SCALES = (1, 100, 255)
"""Sums of probabilities: as numbers, percentages and bytes."""

_BYTE = 255
"""Number of steps of coarse probabilities, which are quantized or clipped near 0 and 1."""

_OVERSHOOT = 0.5
"""Largest distance beyond 0 and 1 of probabilities after bicubic interpolation."""

_WILD = 30.0
"""Standard deviation of an image that drives scores far from 0 and 1."""

_CERTAIN = ("logits", "sigmoid_logits")
"""Kinds that are certain after one image."""

_OF_ONE_SCORE: dict[ScoreKind, ScoreKind] = {
    "logits": "sigmoid_logits",
    "probabilities": "sigmoid",
}
"""Kinds of a single score: a softmax over it is always 1, so such networks use a sigmoid."""

_NAME_SCORES = (
    "Name it: scores=logits for a network whose last step, a softmax, is missing; "
    "scores=probabilities for one that ends in it."
)
_NAME_SCORE = (
    "Set scores=sigmoid_logits if a sigmoid follows, with numbers above 0 for the class. A "
    "logarithm of a sigmoid is at most 0: save the network without the logarithm and set "
    "scores=sigmoid."
)
_FACTOR = (
    "If they are probabilities times a factor (100, 255), save the network without the factor and "
    "set scores=sigmoid."
)


@torch.no_grad()
def try_network(network: PhotoNetwork) -> tuple[ScoreKind, int]:
    """Return the kind of a network's scores and their number K, 1 for label maps.

    The kind is the one that the user or the network's library states. Otherwise the network gets
    up to four images, because a single one may mislead:

    * One score: whole numbers are labels, numbers from 0 to 1 come from a sigmoid, and numbers of
      both signs precede one. For one or two names, 0 and one number above 1 (255) are a mask,
      which counts as a sigmoid.
    * More scores: the same sum at every pixel indicates a softmax, even if the scores are rounded,
      clipped, or slightly negative after a bicubic interpolation. So does a sum of 1 over the whole
      image. Other scores from 0 to 1 come from sigmoids.

    Args:
        network: The network; in evaluation mode afterwards.

    Raises:
        SettingError: The network does not take RGB images of its size, or its scores fit no kind.
    """
    network.network.eval()
    stated, named = network.score_kind, len(network.score_names)
    kind, tried = stated, []
    for image in trial_images(network):
        tried.append(trial_output(network, image).movedim(1, 0).flatten(1))
        kind = stated or _kind_of(tried, named)
        if kind in _CERTAIN:
            break
    pixels = torch.cat(tried, dim=1)
    count, least, most = len(pixels), pixels.amin().item(), pixels.amax().item()
    if not pixels.isfinite().any():
        raise SettingError(
            "output of the network",
            found="no finite number",
            expected="scores or labels",
            remedy="Check the weights: they may contain NaN.",
        )
    if kind is None:
        raise SettingError(
            "scores",
            found=f"{count} per pixel, from {least:g} to {most:g}",
            expected=f"of a kind that can be recognized: {', '.join(get_args(ScoreKind))}",
            remedy=_NAME_SCORES if count > 1 else _FACTOR if least >= 0 else _NAME_SCORE,
        )
    if count == 1 and stated != "labels" and bool((pixels == 1).all()):
        raise SettingError(
            "scores",
            found="1 at every pixel, such as a softmax over one score",
            expected="scores that differ",
            remedy="Save the network without its softmax and set scores=sigmoid_logits. "
            "For label maps, set scores=labels.",
        )
    if kind == "labels":
        _check_labels(np.unique(pixels.nan_to_num(_VOID).numpy()).tolist(), named)
    kind = _OF_ONE_SCORE.get(kind, kind) if count == 1 else kind
    if kind == "probabilities":
        is_wrong = least < 0 and _kind_of(tried, named) != kind
    else:
        is_beyond = least < -_OVERSHOOT or most > 1 + _OVERSHOOT
        is_wrong = kind == "sigmoid" and is_beyond and not _is_mask(pixels)
    if is_wrong:
        raise SettingError(
            "scores",
            found=f"{stated or kind}, but numbers from {least:g} to {most:g}",
            expected="probabilities from 0 to 1",
            remedy=_FACTOR if least >= 0 else "",
        )
    return kind, count


def trial_images(network: PhotoNetwork) -> Iterator[Tensor]:
    """Yield normalized images: black, white, noise, and noise far beyond the range of colors."""
    mean, std = (
        torch.tensor(values, dtype=torch.float32)[:, None, None]
        for values in (network.normalization.mean, network.normalization.std)
    )
    generator = torch.Generator().manual_seed(0)
    shape = (1, 3, *network.image_size)
    for image in (torch.zeros(shape), torch.ones(shape), torch.rand(shape, generator=generator)):
        yield (image - mean) / std
    yield _WILD * torch.randn(shape, generator=generator)


def trial_output(network: PhotoNetwork, image: Tensor) -> Tensor:
    """Return scores ``(1, K, h, w)`` as float32; label maps and depth have K = 1.

    Raises:
        SettingError: The network does not take the image, or returns another shape.
    """
    try:
        scores = plain_scores(network.network(image))
    except Exception as error:  # networks raise many kinds about images they do not take
        if isinstance(error, SettingError) and str(error.subject).startswith("output of"):
            raise
        raise SettingError(
            "network",
            found=f"{type(error).__name__} ({first_line(error)}) for an RGB image of "
            f"{width_height(image.shape[2:])}",
            expected="scores, labels or depth",
            remedy="If it needs another size, set image_size=[rows,columns]. "
            "Networks for other images than RGB cannot be imported.",
        ) from error
    scores = scores[:, None] if scores.ndim == image.ndim - 1 else scores
    if scores.shape[0] != 1 or scores.shape[2:] != image.shape[2:]:
        rows, columns = image.shape[2:]
        raise SettingError(
            "output of the network",
            found=tuple(scores.shape),
            expected=f"scores (1, K, {rows}, {columns}), or labels or depth (1, {rows}, {columns})",
        )
    return scores.float()


def _check_labels(found: Sequence[float], named: int) -> None:
    """Refuse labels without a name, except one value for void, e.g. 255."""
    known = max(2, named)  # a single class has the label 1 and a background 0
    others = 0 not in found or (1 not in found and max(found) > 1)
    is_two_valued = len([label for label in found if label > 1]) <= 1
    if known in found or (named == 1 and others) or (named <= _MASK_NAMES and not is_two_valued):
        raise SettingError(
            "class names of the network",
            found=f"{named}, for labels {', '.join(f'{label:g}' for label in found[:_LISTED])}",
            expected="a name for each label; a single name is for label 1, with background 0",
            remedy="Name the other labels too; unknown_classes= lists names to write as unknown."
            + f" {_FACTOR}" * (named <= _MASK_NAMES),
        )


def _kind_of(tried: Sequence[Tensor], named: int) -> ScoreKind | None:
    """Return the kind of the scores ``(K, pixels)`` of some images; None if it is unclear."""
    scores = torch.cat(list(tried), dim=1)
    whole = bool(((scores == scores.round()) | scores.isnan()).all())
    scores = scores[:, scores.isfinite().all(dim=0)]
    if not scores.numel():
        return None
    least, most = scores.amin().item(), scores.amax().item()
    # ONNX's Softmax before version 13 normalizes over classes, rows and columns together.
    over_image = least >= 0 and all(abs(float(s.double().sum()) - 1) < _ROUNDED for s in tried)
    if len(scores) == 1:
        kind = _kind_of_one(scores, whole, named)
        return None if over_image and kind == "sigmoid" else kind
    if most > least and (over_image or _has_even_sums(scores, whole)):
        return "probabilities"
    if most > least >= 0 and most <= 1:
        return "sigmoid"
    return "logits" if least < 0 or not whole else None


def _kind_of_one(scores: Tensor, whole: bool, named: int) -> ScoreKind | None:
    """Return the kind of a single score; None if it is unclear."""
    least, most = scores.amin().item(), scores.amax().item()
    if named <= _MASK_NAMES and _is_mask(scores):
        return "sigmoid"
    if whole and len(np.unique(scores[scores < 0].numpy())) <= 1:  # e.g. -1 for void
        return "labels"
    if least >= 0 and most <= 1:
        return "sigmoid"
    return "sigmoid_logits" if least < 0 < most else None


def _is_mask(scores: Tensor) -> bool:
    """Return True for a single score that is 0 or one number above 1, such as 255."""
    values = np.unique(scores.numpy()).tolist()
    return len(scores) == 1 and len(values) == 2 and values[0] == 0 and values[1] > 1


def _has_even_sums(scores: Tensor, whole: bool) -> bool:
    """Return True if the scores of all pixels have the same sum, up to rounding of each score."""
    sums = scores.sum(dim=0)
    mean = sums.mean().item()
    steps = {scale: len(scores) * max(scale / _BYTE, float(whole)) for scale in _SCALES}
    allowed = [(mean, _ROUNDED * mean), *((s, min(step, s / 2)) for s, step in steps.items())]
    is_even = any((sums - total).abs().max() <= most for total, most in allowed)
    return is_even and bool(scores.amin() >= -mean)
