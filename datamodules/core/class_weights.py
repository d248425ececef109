"""Weights of the classes in the loss, from how often they occur."""

from __future__ import annotations

from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

ClassWeights = Literal["log", "sqrt", "effective", "none"]
"""Class weighting of the loss; see `class_weights`."""

_LOG_OFFSET = 1.02


def class_weights(counts: NDArray[np.int64], kind: ClassWeights) -> Tensor:
    """Weights of the classes.

    With r the share of a class among the pixels that have one: `log` is ``1 / ln(1.02 + r)``
    (released code of the paper), `sqrt` is ``1 / √r``, `effective` is ``1 / (1 − e^(−r K))`` with K
    classes seen, the last two scaled to a mean of 1; `none` is 1.

    `effective` is ``(1 − β) / (1 − βⁿ)`` for n pixels (Cui et al., "Class-Balanced Loss Based on
    Effective Number of Samples", CVPR 2019, equation 4) with 1/(1 − β), the number of pixels that
    there is something to be learned from, set to the mean count of the seen classes. Pixels are no
    samples: neighbours are alike, and their number grows with the resolution. With Cui's own β, up
    to 0.9999, some ten thousand pixels are all there is to learn from, and the weights of all
    classes equal; with this β only the shares count, as with the others. Classes rarer than the
    mean weigh about as ``1 / r``, more frequent ones nearly the same.

    Args:
        counts: ``(K,)`` pixels of every class.
        kind: Kind of weighting.

    Returns:
        ``(K,)`` float32; but for `none`, 0 for classes never seen.
    """
    weights = np.ones(len(counts))
    if kind != "none":
        seen = counts > 0
        weights[~seen] = 0
        if seen.any():
            weights[seen] = _of_shares(counts[seen] / counts.sum(), kind)
    return torch.from_numpy(weights.astype(np.float32))


def _of_shares(
    ratio: NDArray[np.float64], kind: Literal["log", "sqrt", "effective"]
) -> NDArray[np.float64]:
    if kind == "log":
        log: NDArray[np.float64] = 1 / np.log(_LOG_OFFSET + ratio)
        return log
    weights = 1 / np.sqrt(ratio) if kind == "sqrt" else -1 / np.expm1(-ratio * len(ratio))
    scaled: NDArray[np.float64] = weights / weights.mean()
    return scaled
