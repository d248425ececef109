"""Labelled images by number, whatever they show and wherever they come from."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any, Generic, Protocol, TypeVar

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable, Generator

    from numpy.typing import NDArray

    from tangent_train.rendering.representation import Sampler

__all__ = [
    "ImageSource",
    "LabelledImage",
    "RememberedImages",
    "ShownImage",
    "count_labels",
    "in_threads",
]


class ShownImage(Protocol):
    """What a network is shown views of."""

    @property
    def rgb(self) -> NDArray[np.uint8]:
        """``(H, W, 3)`` colours."""
        ...

    @property
    def depth(self) -> NDArray[np.uint16] | None:
        """``(H, W)`` distance from the centre of projection in steps of 1/512 m, 0 where missing.

        None where the data set has, or is asked for, none.
        """
        ...

    @property
    def up(self) -> NDArray[np.float64] | None:
        """``(3,)`` direction of the zenith in a panorama; None where that is z, and in photos."""
        ...


class LabelledImage(ShownImage, Protocol):
    """A panorama or a photo: a named tuple of arrays, not to be written to."""

    @property
    def labels(self) -> NDArray[np.uint8]:
        """``(H, W)`` classes, 0 where unknown."""
        ...

    def sampler(self, representation: Any) -> Sampler:
        """What draws the views of this image."""
        ...

    def target(self, representation: Any) -> NDArray[np.uint8]:
        """The labels that predictions are compared with."""
        ...


_Image = TypeVar("_Image", bound=LabelledImage)
_Image_co = TypeVar("_Image_co", bound=LabelledImage, covariant=True)
_Read = TypeVar("_Read")


class ImageSource(Protocol[_Image_co]):
    """Images by number."""

    def __len__(self) -> int:
        """How many there are."""
        ...

    def name(self, index: int) -> str:
        """A short name of one of them, which no other has; with ``/`` between groups."""
        ...

    def read(self, index: int) -> _Image_co:
        """One of them."""
        ...

    def label_counts(self, index: int) -> NDArray[np.int64]:
        """Its pixels of every label, ``(256,)``, for less than the price of reading all of it."""
        ...


class RememberedImages(Generic[_Image]):
    """The images of another source, read once, now, and kept in memory.

    Made before the loader's workers start, which then share the memory (on systems that fork);
    each process of a distributed run keeps its own: six bytes a pixel with depth, four without.

    Args:
        source: Where they come from.
    """

    def __init__(self, source: ImageSource[_Image]) -> None:
        self._source = source
        self._kept = list(in_threads(self._read, len(source)))

    def __len__(self) -> int:
        return len(self._kept)

    def name(self, index: int) -> str:
        """The name in the source."""
        return self._source.name(index)

    def read(self, index: int) -> _Image:
        """The image as the source gave it."""
        return self._kept[index]

    def label_counts(self, index: int) -> NDArray[np.int64]:
        """Its pixels of every label."""
        return count_labels(self._kept[index].labels)

    def _read(self, index: int) -> _Image:
        # Copies: arrays that are views of a file would keep it open.
        image: Any = self._source.read(index)
        kept: _Image = image._make(None if part is None else np.array(part) for part in image)
        return kept


def count_labels(labels: NDArray[np.uint8]) -> NDArray[np.int64]:
    """Number of pixels of every label, ``(256,)``."""
    return np.bincount(labels.ravel(), minlength=256)


def in_threads(read: Callable[[int], _Read], count: int) -> Generator[_Read]:
    """``read(0)`` … ``read(count - 1)``, on all cores (OpenCV and zlib free the GIL)."""
    workers = os.cpu_count() or 1
    with ThreadPoolExecutor(workers) as pool:
        # A few at a time: the reader is never far ahead of who consumes them.
        for start in range(0, count, 4 * workers):
            yield from pool.map(read, range(start, min(start + 4 * workers, count)))
