"""Reading the images or shapes of one split from files, a store or memory."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from datamodules.core.index import DatasetIndex, Item, Split
from datamodules.core.problems import Problems
from datamodules.core.store import Store
from tangent_train.threads import in_threads

_Item = TypeVar("_Item", bound=Item)
_Image = TypeVar("_Image")

Transform = Callable[[_Image, int, _Item], _Image]
"""Function that changes an image, given its index in the split and its files."""


class SplitReader(Generic[_Item, _Image]):
    """Reader of the images of one split, by index.

    Args:
        index: Index of all images; arrays of its store are memory-mapped, not copied.
        split: Name of the split.
        transforms: Transforms of every image, in order.

    Attributes:
        items: Files of each image.
        transforms: Transforms of every image, in order.
    """

    def __init__(
        self,
        index: DatasetIndex[_Item],
        split: Split,
        transforms: Sequence[Transform[_Image, _Item]] = (),
    ) -> None:
        self.items = index.splits[split]
        self._decode, self._store = index.read, index.store
        self._kind = index.kind
        self.transforms = transforms
        self._kept: list[_Image] = []

    def __len__(self) -> int:
        return len(self.items)

    def name(self, index: int) -> str:
        """Unique short name of an item; ``/`` between groups."""
        return self.items[index].name

    def read(self, index: int) -> _Image:
        """Read one image; its arrays may be shared or read-only.

        Raises:
            DataError: A file is broken, or its prepared version is missing or out of date.
        """
        if self._kept:
            return self._kept[index]
        item = self.items[index]
        image = self._decode(item) if self._store is None else self._stored(self._store, item)
        for transform in self.transforms:
            image = transform(image, index, item)
        return image

    def labels(self, index: int) -> NDArray[Any]:
        """Read the labels of one image, which is faster than the whole image."""
        decode: Any = self._decode
        is_decoded = self._kept or self.transforms or self._store is not None
        image: Any = self.read(index) if is_decoded else None
        labels: NDArray[Any] = image.labels if is_decoded else decode.labels(self.items[index])
        return labels

    def keep_in_memory(self, root: object) -> None:
        """Read all images now and keep them in memory.

        Call this before the loader's workers start: where processes fork, they share the memory.
        Every process of a distributed run keeps a copy.

        Args:
            root: Folder of the data set, for error messages.

        Raises:
            DataError: Lists all broken images.
        """
        problems = Problems()

        def keep(index: int) -> Any:
            with problems.noted(self.name(index)):
                image: Any = self.read(index)
                # Copies, because arrays that are views of a file keep it open.
                return image._make(np.array(a) if isinstance(a, np.ndarray) else a for a in image)

        kept = list(in_threads(keep, range(len(self))))
        problems.refuse(root)
        self._kept = kept

    def _stored(self, store: Store, item: _Item) -> _Image:
        arrays = store.read(item.name, item.parts)
        # A store prepared with depth also serves runs without depth.
        read = {key: a for key, a in arrays.items() if key != "depth" or "depth" in item.parts}
        image: _Image = self._kind(**{**dict.fromkeys(self._kind._fields), **read})
        return image
