"""Losses as a sum and its norm, so that any split of a batch adds up to one gradient."""

from __future__ import annotations

import torch
from jaxtyping import Float, UInt8
from torch import Tensor
from torch.nn import functional


def cross_entropy_sum(
    scores: Float[Tensor, "images classes height width"],
    labels: UInt8[Tensor, "images height width"],
    class_weights: Float[Tensor, " classes"],
    label_smoothing: float = 0.0,
) -> Tensor:
    """Weighted cross-entropy, summed; unknown pixels (label 0) are ignored.

    Divided by the `cross_entropy_norm` of the same images it is torch's weighted mean. Divided by
    the norm of *all* images, chunks and processes instead, it is their share of one mean.

    Args:
        scores: Logits of the K classes.
        labels: 1 … K; 0 is unknown.
        class_weights: Weight of every class.
        label_smoothing: Fraction of the target that is spread evenly over the classes.
    """
    exact = _exact(scores)
    return functional.cross_entropy(
        exact,
        labels.long() - 1,
        class_weights.to(exact),
        ignore_index=-1,
        reduction="sum",
        label_smoothing=label_smoothing,
    )


def cross_entropy_norm(
    labels: UInt8[Tensor, "images height width"], class_weights: Float[Tensor, " classes"]
) -> Tensor:
    """Sum of the class weights of the labelled pixels, known before the forward pass."""
    # Not counts of the classes: torch.bincount makes the host wait for a GPU.
    of_label = functional.pad(_exact(class_weights), (1, 0))
    return of_label.index_select(0, labels.flatten().int()).sum()


def auxiliary_sum(
    scores: Float[Tensor, "images classes rows columns"],
    labels: UInt8[Tensor, "images height width"],
    class_weights: Float[Tensor, " classes"],
) -> Tensor:
    """Weighted cross-entropy of the cells of a coarser network stage, summed over pixels.

    Every cell is compared with the class histogram of the pixels whose centers lie in it. That is
    the cross-entropy of the pixels, each with the scores of its cell, without upsampling them; its
    norm is their `cross_entropy_norm`.

    Args:
        scores: Logits of the cells, of any size.
        labels: 1 … K of the pixels; 0 is unknown and ignored.
        class_weights: Weight of every class.
    """
    exact = _exact(scores)
    images, classes, *size = scores.shape
    rows, columns = (
        # The cell of every pixel center along a side.
        (2 * torch.arange(side, device=labels.device) + 1) * cells // (2 * side)
        for side, cells in zip(labels.shape[1:], size, strict=True)
    )
    image = torch.arange(images, device=labels.device)[:, None, None]
    cell = (image * size[0] + rows[:, None]) * size[1] + columns
    bins = cell * (classes + 1) + labels
    counts = exact.new_zeros(images * size[0] * size[1] * (classes + 1))
    counts.scatter_add_(0, bins.flatten(), counts.new_ones(()).expand(bins.numel()))
    histograms = counts.view(images, *size, classes + 1)[..., 1:].movedim(-1, 1)
    # Counts instead of probabilities: every pixel weighs the same, however many a cell has.
    return functional.cross_entropy(exact, histograms, class_weights.to(exact), reduction="sum")


def _exact(values: Tensor) -> Tensor:
    """Sums of millions of pixels: never in half precision."""
    return values.to(torch.promote_types(values.dtype, torch.float32))
