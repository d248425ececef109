"""Objects in images: what networks for instances return besides scores."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor


class Segments(NamedTuple):
    """Objects of one image, without stuff. They do not overlap.

    Attributes:
        numbers: ``(h, w)`` int32 number of the object at each pixel, from 1; 0 for none.
        classes: ``(m,)`` int64 index of the class of each object, as in the scores of the network.
        scores: ``(m,)`` float32 confidence of each object, more than 0 to 1.
    """

    numbers: Tensor
    classes: Tensor
    scores: Tensor


def front_segments(masks: Tensor, classes: Tensor, scores: Tensor) -> Segments:
    """Return objects in ascending order of scores; where masks overlap, the best one is in front.

    Args:
        masks: ``(m, h, w)`` True inside the object.
        classes: ``(m,)`` int64 index of the class.
        scores: ``(m,)`` confidence.
    """
    order = scores.argsort()
    numbers = torch.zeros(masks.shape[1:], dtype=torch.int32, device=scores.device)
    for number, mask in enumerate(masks[order], start=1):
        numbers[mask] = number
    return Segments(numbers, classes[order], scores[order])
