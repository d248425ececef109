"""Class frequencies: weights of the classes in the loss, and warnings about unlikely labels."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

ClassWeights = Literal["log", "sqrt", "none"]
"""Class weighting of the loss; see `class_weights`."""

_LOG_OFFSET = 1.02
_MOST_UNKNOWN = 0.5
_MOST_NAMED = 10


def class_weights(counts: NDArray[np.int64], kind: ClassWeights) -> Tensor:
    """Return the weights of the classes in the loss.

    With r the share of a class among the labeled pixels: `log` is ``1 / ln(1.02 + r)``
    (released code of the paper), `sqrt` is ``1 / √r``, scaled to a mean of 1; `none` is 1.

    Args:
        counts: ``(K,)`` number of pixels of every class.
        kind: Kind of weighting.

    Returns:
        ``(K,)`` float32; 0 for classes without pixels, except with `none`.
    """
    if kind == "none":
        return torch.ones(len(counts))
    seen = counts > 0
    shares = counts[seen] / counts.sum()
    of_seen = 1 / (np.log(_LOG_OFFSET + shares) if kind == "log" else np.sqrt(shares))
    if kind == "sqrt" and len(of_seen):
        of_seen /= of_seen.mean()
    weights = np.zeros(len(counts), np.float32)
    weights[seen] = of_seen
    return torch.from_numpy(weights)


def label_doubts(split: str, counts: NDArray[np.int64], class_names: Sequence[str]) -> list[str]:
    """Return warnings about labels that may belong to other classes.

    Args:
        split: Name of the split.
        counts: ``(K+1,)`` number of pixels of every label, at least one above 0.
        class_names: ``(K+1,)`` names; the first is the name of unknown pixels.
    """
    doubts = []
    unknown = counts[0] / counts.sum()
    if unknown > _MOST_UNKNOWN:
        doubts.append(f"{100 * unknown:.1f} % of the pixels for {split} are unknown.")
    missing = [name for name, count in zip(class_names[1:], counts[1:], strict=True) if not count]
    if missing:
        more = f" and {len(missing) - _MOST_NAMED} more" if len(missing) > _MOST_NAMED else ""
        doubts.append(
            f"Classes without a pixel for {split}: {', '.join(missing[:_MOST_NAMED])}{more} "
            f"({len(missing)} of {len(class_names) - 1})."
        )
    return doubts
