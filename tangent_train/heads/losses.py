"""Losses as a sum and its norm, so that the parts of a batch add up to one gradient."""

from __future__ import annotations

from typing import Literal

import torch
from jaxtyping import Float, UInt8
from torch import Tensor
from torch.nn import functional

DepthLoss = Literal["log_l1", "scale_invariant"]
"""Loss of predicted distances, see `log_error_sum`."""


def cross_entropy_sum(
    scores: Float[Tensor, "images classes height width"],
    labels: UInt8[Tensor, "images height width"],
    class_weights: Float[Tensor, " classes"],
    label_smoothing: float = 0.0,
) -> Tensor:
    """Sum the weighted cross-entropy of pixels; unknown pixels (label 0) are ignored.

    Divided by the `cross_entropy_norm` of the same images, it is torch's weighted mean. Divided by
    the norm of *all* images, chunks and processes, it is the share of these images in one mean.

    Args:
        scores: Scores of the K classes, before a softmax.
        labels: Labels from 1 to K; 0 is unknown.
        class_weights: Weight of each class.
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
    """Sum the class weights of the labeled pixels, which needs no forward pass."""
    # Not with torch.bincount, for which the host waits for a GPU.
    label_weights = functional.pad(_exact(class_weights), (1, 0))
    return label_weights.index_select(0, labels.flatten().int()).sum()


def auxiliary_sum(
    scores: Float[Tensor, "images classes rows columns"],
    labels: UInt8[Tensor, "images height width"],
    class_weights: Float[Tensor, " classes"],
) -> Tensor:
    """Sum the weighted cross-entropy of pixels, with scores of a coarser stage of a network.

    Each cell is compared with the class histogram of the pixels whose centers lie in it. This is
    the cross-entropy of the pixels, each with the scores of its cell, without upsampling the
    scores; its norm is the `cross_entropy_norm` of the pixels.

    Args:
        scores: Scores of the cells, before a softmax; their size may differ from that of the
            labels.
        labels: Labels of the pixels from 1 to K; 0 is unknown and ignored.
        class_weights: Weight of each class.
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
    # Counts instead of probabilities: pixels weigh the same in cells with few and many of them.
    return functional.cross_entropy(exact, histograms, class_weights.to(exact), reduction="sum")


def log_error_sum(
    errors: Float[Tensor, "images height width"], kind: DepthLoss, scale_invariance: float
) -> Tensor:
    """Sum the loss of logarithmic errors e = ln d − ln g; divide it by the number of known pixels.

    * `log_l1`: ``Σ |e|``.
    * `scale_invariant`: ``Σᵢ (Σ e² − λ (Σ e)² / nᵢ)`` over the images i of the network with nᵢ
      known pixels each (Eigen, Puhrsch and Fergus, NeurIPS 2014, equation 4). A chunk contains
      whole images, so that the sum is exact for all divisions of a step.

    Args:
        errors: Errors; NaN where the true distance is unknown.
        kind: Kind of the loss.
        scale_invariance: λ from 0 to 1: 1 ignores a common scale of each image.
    """
    known = ~errors.isnan()
    exact = _exact(errors).where(known, 0)
    if kind == "log_l1":
        return exact.abs().sum()
    counts = known.flatten(1).sum(dim=1).clamp(min=1)
    common = exact.flatten(1).sum(dim=1).square() / counts
    return exact.square().sum() - scale_invariance * common.sum()


def _exact(values: Tensor) -> Tensor:
    """Convert to at least float32, for sums over millions of pixels."""
    return values.to(torch.promote_types(values.dtype, torch.float32))
