"""Losses as a sum and its norm, so that any split of a batch adds up to one gradient."""

from __future__ import annotations

from typing import NamedTuple

from jaxtyping import Float, UInt8
from torch import Tensor
from torch.nn import functional

__all__ = ["UNKNOWN", "LossSum", "cross_entropy_sum"]

UNKNOWN = 0
"""Class index of unlabelled pixels, everywhere."""


class LossSum(NamedTuple):
    """A loss not yet divided by its norm.

    Attributes:
        total: Sum over the labelled pixels.
        norm: What to divide the sum by: the class weights of the labelled pixels, added up.
    """

    total: Tensor
    norm: Tensor


def cross_entropy_sum(
    scores: Float[Tensor, "images classes height width"],
    labels: UInt8[Tensor, "images height width"],
    class_weights: Float[Tensor, " classes"],
    label_smoothing: float = 0.0,
) -> LossSum:
    """Weighted cross-entropy; unknown pixels (class 0) count for nothing.

    ``total / norm`` over one batch is torch's weighted mean. Dividing by the norm of *all* images,
    chunks and processes instead makes them one batch.

    Args:
        scores: Logits.
        labels: Class indices; 0 is unknown.
        class_weights: Weight of every class.
        label_smoothing: Share of the target spread evenly over the classes.

    Returns:
        Sum and norm.
    """
    target = labels.long()
    total = functional.cross_entropy(
        scores,
        target,
        class_weights,
        ignore_index=UNKNOWN,
        reduction="sum",
        label_smoothing=label_smoothing,
    )
    known = target != UNKNOWN
    return LossSum(total, class_weights[target[known]].sum())
