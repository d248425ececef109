"""Weights of the classes in the loss, from how often they occur."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

import numpy as np
import torch

from tangent_train.errors import SettingError

if TYPE_CHECKING:
    from numpy.typing import NDArray
    from torch import Tensor

__all__ = ["ClassWeights", "class_weights"]

ClassWeights = Literal["log", "sqrt", "none"]
"""How the loss weighs classes; see `class_weights`."""

_LOG_OFFSET = 1.02


def class_weights(counts: NDArray[np.int64], kind: ClassWeights) -> Tensor:
    """Weights of the classes.

    With r the share of a class among the pixels that have one: `log` is ``1 / ln(1.02 + r)``
    (released code of the paper), `sqrt` is ``1 / √r`` scaled to a mean of 1, `none` is 1.

    Args:
        counts: ``(classes,)`` pixels of every label, the unknown one first.
        kind: Which.

    Returns:
        ``(classes,)`` float32, 0 for the unknown label and, but for `none`, for classes never seen.

    Raises:
        SettingError: Another kind.
    """
    if kind not in ("log", "sqrt", "none"):
        raise SettingError("class weights", found=repr(kind), expected="log, sqrt or none")
    weights = np.ones(len(counts))
    if kind != "none":
        seen = counts > 0
        seen[0] = False
        ratio = counts[seen] / counts[1:].sum()
        weights[~seen] = 0
        if kind == "log":
            weights[seen] = 1 / np.log(_LOG_OFFSET + ratio)
        else:
            weights[seen] = 1 / np.sqrt(ratio)
            weights[seen] /= weights[seen].mean()
    weights[0] = 0
    return torch.from_numpy(weights.astype(np.float32))
