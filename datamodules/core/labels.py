"""Kinds of labels, provided by data sets and required by tasks, and sets of classes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

PIXEL_CLASSES = "pixel_classes"
"""A class index for every pixel; 0 is unknown, which is not a class of the network."""

IMAGE_CLASS = "image_class"
"""One class index for an image or shape."""

DISTANCE = "distance"
"""A distance from the center for every pixel, in steps of 1/512 m, 0 where unknown."""


@dataclass(frozen=True)
class ClassSet:
    """Classes of a benchmark, made from the classes of a data set.

    Attributes:
        names: K names; the label of a class is its index plus one.
        of: Names of all classes of the data set, in the order of its labels.
        merged: Names in `names` by names of the data set, where they differ. Classes in neither of
            them are unknown.
    """

    names: tuple[str, ...]
    of: tuple[str, ...]
    merged: Mapping[str, str] = field(default_factory=dict)

    @property
    def key(self) -> NDArray[np.uint8]:
        """``(256,)`` label by label of the data set; 255 past its classes.

        >>> ClassSet(("car", "bus"), ("bus", "truck", "sky"), {"truck": "car"}).key[:5].tolist()
        [0, 2, 1, 0, 255]
        """
        labels = {name: label for label, name in enumerate(self.names, start=1)}
        key = np.full(256, 255, np.uint8)
        key[: len(self.of) + 1] = [0, *(labels.get(self.merged.get(n, n), 0) for n in self.of)]
        return key

    def relabel(self, labels: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return the labels of an image in this set; 255 for labels that are not of the data set.

        Args:
            labels: ``(H, W)`` labels of the data set, 0 where unknown.
        """
        return self.key[labels]


def class_sets(classes: Sequence[str], others: Mapping[str, ClassSet]) -> dict[str, ClassSet]:
    """Return class sets by name; first all classes, named by their number."""
    every = tuple(classes)
    return {str(len(every)): ClassSet(every, every), **others}
