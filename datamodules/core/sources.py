"""Labelled images by number, whatever they show and wherever they come from."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any, Generic, Protocol, TypeVar

import numpy as np

from datamodules.core.problems import Problems

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Sequence

    from numpy.typing import NDArray

    from tangent_train.rendering.representations.pinhole import Sampler

__all__ = [
    "ImageSource",
    "LabelledImage",
    "ReadableImages",
    "RememberedImages",
    "ShownImage",
    "count_labels",
    "in_threads",
    "read_strictly",
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


class ReadableImages(Generic[_Image_co]):
    """Some of the images of another source, as those that are not broken.

    Args:
        source: Where they come from.
        indices: Which, by their numbers there.
    """

    def __init__(self, source: ImageSource[_Image_co], indices: Sequence[int]) -> None:
        self._source = source
        self._indices = tuple(indices)

    def __len__(self) -> int:
        return len(self._indices)

    def name(self, index: int) -> str:
        """The name in the source."""
        return self._source.name(self._indices[index])

    def read(self, index: int) -> _Image_co:
        """The image as the source gives it."""
        return self._source.read(self._indices[index])

    def read_strictly(self, index: int) -> _Image_co:
        """See `read_strictly`."""
        return read_strictly(self._source, self._indices[index])

    def label_counts(self, index: int) -> NDArray[np.int64]:
        """Its pixels of every label."""
        return self._source.label_counts(self._indices[index])


class RememberedImages(Generic[_Image]):
    """The images of another source, read once, now, and kept in memory.

    Made before the loader's workers start, which then share the memory (on systems that fork);
    each process of a distributed run keeps its own: six bytes a pixel with depth, four without.

    Args:
        source: Where they come from.
        root: The folder of the data set.

    Raises:
        DataError: Some are broken; all of these are named.
    """

    def __init__(self, source: ImageSource[_Image], root: object = "data") -> None:
        self._source = source
        self._problems = Problems()
        self._kept = [image for read in in_threads(self._read, len(source)) for image in read]
        self._problems.refuse(root, left=len(self._kept))

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

    def _read(self, index: int) -> list[_Image]:
        """The image; none after an error."""
        kept: list[_Image] = []
        with self._problems.noted(index):
            image: Any = read_strictly(self._source, index)
            # Copies: arrays that are views of a file would keep it open.
            copies = (None if part is None else np.array(part) for part in image)
            kept.append(image._make(copies))
        return kept


def read_strictly(source: ImageSource[_Image_co], index: int) -> _Image_co:
    """Read an image for the first time: what every further time is forgiven is an error now.

    Args:
        source: One that may have a `read_strictly` of its own, which finds more than its `read`, as
            labels past the end of the class table.
        index: Which.

    Raises:
        DataError: The image is broken.
    """
    read: Callable[[int], _Image_co] = getattr(source, "read_strictly", source.read)
    return read(index)


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
