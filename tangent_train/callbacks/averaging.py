"""Exponential moving average of the weights in training."""

from __future__ import annotations

import torch
from lightning.pytorch.callbacks import WeightAveraging
from torch import Tensor

from tangent_train.errors import SettingError

__all__ = ["averaged_weights"]


def averaged_weights(decay: float, device: torch.device) -> WeightAveraging:
    """Lightning's callback, whose average starts faster: it is what is validated and kept.

    After t steps the average moves by ``1 − min(decay, (1 + t) / (10 + t))`` towards the weights.
    With a constant decay, as in Lightning's `EMAWeightAveraging`, a short training would keep an
    average of mostly untrained weights as its best checkpoint.

    Args:
        decay: Of the average in a long training, such as 0.999.
        device: Of the training; by default the average would stay on the CPU.

    Raises:
        SettingError: The decay is not between 0 and 1.
    """
    if not 0 < decay < 1:
        raise SettingError("ema", found=decay, expected="a decay between 0 and 1, or null")

    def move(averages: list[Tensor], weights: list[Tensor], steps: Tensor) -> None:
        if averages[0].is_floating_point():
            kept = min(decay, (1 + int(steps)) / (10 + int(steps)))
            torch._foreach_lerp_(averages, weights, 1 - kept)
        else:  # counts of batches
            torch._foreach_copy_(averages, weights)

    return WeightAveraging(device=device, multi_avg_fn=move)
