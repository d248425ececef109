"""Weights of the classes in the loss, from how often they occur."""

from __future__ import annotations

from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

ClassWeights = Literal["log", "sqrt", "none"]
"""Class weighting of the loss; see `class_weights`."""

_LOG_OFFSET = 1.02


def class_weights(counts: NDArray[np.int64], kind: ClassWeights) -> Tensor:
    """Weights of the classes.

    With r the share of a class among the pixels that have one: `log` is ``1 / ln(1.02 + r)``
    (released code of the paper), `sqrt` is ``1 / √r``, scaled to a mean of 1; `none` is 1.

    Args:
        counts: ``(K,)`` pixels of every class.
        kind: Kind of weighting.

    Returns:
        ``(K,)`` float32; but for `none`, 0 for classes never seen.
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
