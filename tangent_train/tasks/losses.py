"""Losses as a sum and its norm, so that any split of a batch adds up to one gradient."""

from __future__ import annotations

from typing import Literal

import torch
from jaxtyping import Float, Int64, UInt8
from torch import Tensor
from torch.nn import functional

from tangent_train.metrics.segmentation import UNKNOWN

__all__ = [
    "AuxiliaryTarget",
    "auxiliary_sum",
    "cross_entropy_norm",
    "cross_entropy_sum",
]

AuxiliaryTarget = Literal["histogram", "labels"]
"""What the cells of a coarser stage are compared with; see `auxiliary_sum`."""


def cross_entropy_sum(
    scores: Float[Tensor, "images classes height width"],
    labels: UInt8[Tensor, "images height width"],
    class_weights: Float[Tensor, " classes"],
    label_smoothing: float = 0.0,
) -> Tensor:
    """Weighted cross-entropy, summed; unknown pixels (class 0) count for nothing.

    Divided by the `cross_entropy_norm` of the same images it is torch's weighted mean. Divided by
    the norm of *all* images, chunks and processes instead, it is their share of one mean.

    Args:
        scores: Logits.
        labels: Class indices; 0 is unknown.
        class_weights: Weight of every class.
        label_smoothing: Share of the target spread evenly over the classes.
    """
    exact = _exact(scores)
    return functional.cross_entropy(
        exact,
        labels.long(),
        class_weights.to(exact),
        ignore_index=UNKNOWN,
        reduction="sum",
        label_smoothing=label_smoothing,
    )


def cross_entropy_norm(
    labels: UInt8[Tensor, "images height width"], class_weights: Float[Tensor, " classes"]
) -> Tensor:
    """The class weights of the labelled pixels, added up: known before any network has run."""
    pixels = torch.bincount(labels.flatten(), minlength=len(class_weights))
    weights = _exact(class_weights)
    # Not a product of matrices: autocast would compute it in half precision.
    return (pixels * weights)[UNKNOWN + 1 :].sum()


def auxiliary_sum(
    scores: Float[Tensor, "images classes rows columns"],
    labels: UInt8[Tensor, "images height width"],
    class_weights: Float[Tensor, " classes"],
    target: AuxiliaryTarget = "histogram",
) -> Tensor:
    """Weighted cross-entropy of the cells of a coarser stage of a network, summed over pixels.

    Either way its norm is the `cross_entropy_norm` of the pixels. `histogram` compares a cell with
    the labels of all pixels whose centres lie in it. That is the cross-entropy of the pixels when
    each has the scores of its cell; the scores are not enlarged for it. `labels` compares a cell
    with the label of the pixel at its centre (of four that meet there, the lower right one), which
    stands for as many pixels as a cell has.

    Args:
        scores: Logits of the cells, of any size.
        labels: Class indices of the pixels; 0 is unknown and counts for nothing.
        class_weights: Weight of every class.
        target: What to compare with.
    """
    size = (scores.shape[-2], scores.shape[-1])
    pixels_per_cell = labels.shape[-2:].numel() / (size[0] * size[1])
    if target == "labels":
        central = _central_labels(labels, size)
        return pixels_per_cell * cross_entropy_sum(scores, central, class_weights)
    if size == labels.shape[-2:]:
        return cross_entropy_sum(scores, labels, class_weights)
    exact = _exact(scores)
    histograms = _histograms(labels, size, scores.shape[1])
    histograms[:, UNKNOWN] = 0
    # Pixels instead of probabilities: every pixel weighs the same, however many a cell has.
    return functional.cross_entropy(
        exact, histograms.to(exact), class_weights.to(exact), reduction="sum"
    )


def _exact(values: Tensor) -> Tensor:
    """Sums of millions of pixels: never in half precision."""
    return values.to(torch.promote_types(values.dtype, torch.float32))


def _centers(count: int, size: int, device: torch.device) -> Int64[Tensor, " count"]:
    """Which of `size` equal parts of a line the centres of `count` equal parts lie in."""
    return (2 * torch.arange(count, device=device) + 1) * size // (2 * count)


def _central_labels(labels: Tensor, size: tuple[int, int]) -> Tensor:
    rows, columns = (
        _centers(n, of, labels.device) for n, of in zip(size, labels.shape[-2:], strict=True)
    )
    return labels[:, rows[:, None], columns]


def _histograms(
    labels: Tensor, size: tuple[int, int], classes: int
) -> Int64[Tensor, "images classes rows columns"]:
    """Pixels of every class whose centres lie in each cell."""
    (height, width), device = labels.shape[-2:], labels.device
    rows, columns = _centers(height, size[0], device), _centers(width, size[1], device)
    images = torch.arange(len(labels), device=device)
    cells = (images[:, None, None] * size[0] + rows[:, None]) * size[1] + columns
    bins = cells * classes + labels
    counts = torch.bincount(bins.flatten(), minlength=len(labels) * size[0] * size[1] * classes)
    return counts.view(len(labels), *size, classes).permute(0, 3, 1, 2)
