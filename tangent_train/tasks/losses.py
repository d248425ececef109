"""Losses as a sum and its norm, so that any split of a batch adds up to one gradient."""

from __future__ import annotations

import torch
from jaxtyping import Float, UInt8
from torch import Tensor
from torch.nn import functional

__all__ = ["UNKNOWN", "cross_entropy_norm", "cross_entropy_sum"]

UNKNOWN = 0
"""Class index of unlabelled pixels, everywhere."""


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
    # A sum of millions of pixels: never in half precision.
    exact = torch.promote_types(scores.dtype, torch.float32)
    return functional.cross_entropy(
        scores.to(exact),
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
    weights = class_weights.to(torch.promote_types(class_weights.dtype, torch.float32))
    return pixels[UNKNOWN + 1 :].to(weights) @ weights[UNKNOWN + 1 :]
