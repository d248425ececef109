"""Objects in images: what networks for instances return besides scores."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor


class Segments(NamedTuple):
    """Objects of one image. They do not overlap.

    Attributes:
        numbers: ``(h, w)`` int32 number of the object at each pixel, from 1; 0 for none.
        classes: ``(m,)`` int64 index of the class of each object, as in the scores of the network.
        scores: ``(m,)`` float32 confidence of each object, more than 0 to 1.
    """

    numbers: Tensor
    classes: Tensor
    scores: Tensor
