"""The images of a split: read from files or a store, masked, rotated, then aligned with gravity."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Generic, Literal, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from datamodules.core.loading import sample_rng
from datamodules.core.panoramas import ImageFiles, Panorama
from datamodules.core.problems import Problems
from datamodules.core.store import Store
from datamodules.images.gpano import up_of, whole_area
from datamodules.images.masks import Masks
from tangent_train.geometry import random_rotation, rotation_about
from tangent_train.rendering import rotate_equirect
from tangent_train.rendering.upright.gravity import estimate_up
from tangent_train.threads import in_threads


class Item(Protocol):
    """The source of one image or shape."""

    @property
    def name(self) -> str:
        """Unique short name."""
        ...

    @property
    def parts(self) -> Mapping[str, Path]:
        """Its files by content."""
        ...


_Item = TypeVar("_Item", bound=Item)
_Image = TypeVar("_Image")

Reading = Callable[[_Item], _Image]
"""Reads an image from its files, a named tuple of arrays; may have a method `labels`."""

PanoramaJudge = Callable[[Panorama, "NDArray[np.float64]"], "NDArray[np.float64]"]
"""Log-likelihoods ``(n,)`` that directions ``(n, 3)`` of a panorama are up."""

Transform = Callable[[_Image, int, _Item], _Image]
"""Changes an image, given its place in the split and its files."""


class SplitItems(Generic[_Item, _Image]):
    """The images of one split, by number.

    Args:
        items: Their files.
        read: Reads one from its files.
        store: Prepared store; its arrays are memory-mapped, not copied.
        kind: Named tuple of `read`, which stored arrays are wrapped in too.
        transforms: Changes to every image, in their order.

    Attributes:
        items: As given.
    """

    def __init__(
        self,
        items: Sequence[_Item],
        read: Reading[_Item, _Image],
        kind: type[_Image],
        store: Store | None = None,
        transforms: Sequence[Transform[_Image, _Item]] = (),
    ) -> None:
        self.items = items
        self._decode = read
        self._kind = kind
        self._store = store
        self._transforms = transforms
        self._kept: list[_Image] = []

    def __len__(self) -> int:
        return len(self.items)

    def name(self, index: int) -> str:
        """Unique short name of an item; ``/`` between groups."""
        return self.items[index].name

    def read(self, index: int) -> _Image:
        """One image; its arrays may be shared or read-only.

        Raises:
            DataError: A file is broken, or its prepared version is missing or out of date.
        """
        if self._kept:
            return self._kept[index]
        item = self.items[index]
        image = self._decode(item) if self._store is None else self._stored(self._store, item)
        for transform in self._transforms:
            image = transform(image, index, item)
        return image

    def labels(self, index: int) -> NDArray[np.uint8]:
        """The labels of one image, cheaper than the whole image."""
        decode: Any = self._decode
        image: Any = None
        if self._kept or self._transforms or self._store is not None:
            image = self.read(index)
        labels: NDArray[np.uint8] = (
            decode.labels(self.items[index]) if image is None else image.labels
        )
        return labels

    def remember(self, root: object) -> None:
        """Read all images now and keep them in memory.

        Done before the loader's workers start, which then share the memory (on systems that fork);
        every process of a distributed run keeps its own.

        Args:
            root: The data set, for messages.

        Raises:
            DataError: Some are broken; all of these are named.
        """
        problems = Problems()

        def keep(index: int) -> Any:
            with problems.noted(self.name(index)):
                image: Any = self.read(index)
                # Copies: arrays that are views of a file would keep it open.
                return image._make(None if a is None else np.array(a) for a in image)

        kept = list(in_threads(keep, range(len(self))))
        problems.refuse(root)
        self._kept = kept

    def _stored(self, store: Store, item: _Item) -> _Image:
        arrays = store.read(item.name, item.parts)
        # Prepared with depth, they also serve runs without.
        read = {key: a for key, a in arrays.items() if key != "depth" or "depth" in item.parts}
        kind: Any = self._kind
        image: _Image = kind(**{**dict.fromkeys(kind._fields), **read})
        return image


def masked(masks: Masks, panorama: Panorama, index: int, files: ImageFiles) -> Panorama:
    """The panorama with labels that are unknown where it does not count; a `Transform`.

    Args:
        masks: Where panoramas count.
        panorama: Its colours and depth stay.
        index: Ignored.
        files: Of the panorama.
    """
    del index
    counts = masks.read(files.name, whole_area(files.rgb, panorama.labels.shape))
    return panorama._replace(labels=panorama.labels & counts)


class PosedUp:
    """Panoramas with the up direction of their GPano tags; None without tags."""

    def __init__(self) -> None:
        self._ups: dict[int, NDArray[np.float64] | None] = {}

    def __call__(self, panorama: Panorama, index: int, files: ImageFiles) -> Panorama:
        """The panorama with `up`."""
        if index not in self._ups:
            self._ups[index] = up_of(files.rgb)
        return panorama._replace(up=self._ups[index])


class EstimatedUp:
    """Panoramas with an estimated up direction if it is unknown.

    Views are aligned with gravity; pixels and labels stay in place.

    Args:
        max_tilt_deg: Maximum tilt, see `estimate_up`.
        judge: Log-likelihoods that directions of a panorama are up, see `estimate_up`; it stays in
            its process.
    """

    def __init__(self, max_tilt_deg: float, judge: PanoramaJudge | None = None) -> None:
        self._max_tilt_deg = max_tilt_deg
        self._judge = judge
        self._ups: dict[int, NDArray[np.float64] | None] = {}

    def __call__(self, panorama: Panorama, index: int, files: ImageFiles) -> Panorama:
        """The panorama with `up`; None if it cannot be estimated."""
        del files
        if panorama.up is not None:
            return panorama
        if index not in self._ups:
            judge = None if self._judge is None else partial(self._judge, panorama)
            self._ups[index] = estimate_up(panorama.rgb, self._max_tilt_deg, judge)
        return panorama._replace(up=self._ups[index])

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_judge": None}


class RotatedPanoramas:
    """Panoramas as seen by a tilted camera.

    Labels rotate with the image, so the score is that of the rotated panorama. The same panorama is
    rotated the same way in every run with the same seed.

    Args:
        rotation: Tilt in degrees about a random horizontal axis, after a random rotation about the
            vertical; or `so3`, uniform over all rotations.
        seed: Seed of the rotations.
        known: Whether the up direction is known, as from a camera with a gravity sensor.
    """

    def __init__(self, rotation: float | Literal["so3"], seed: int, *, known: bool = False) -> None:
        self._rotation = rotation
        self._seed = seed
        self._known = known

    def rotation(self, index: int) -> NDArray[np.float64]:
        """The rotation of one panorama, ``(3, 3)``: what was seen at d is now seen at R d."""
        rng = sample_rng(self._seed, 0, index)
        if self._rotation == "so3":
            return random_rotation(rng)
        yaw, azimuth = rng.uniform(0, 2 * math.pi, 2)
        axis = (math.cos(azimuth), math.sin(azimuth), 0)
        tilt = rotation_about(axis, math.radians(self._rotation))
        return tilt @ rotation_about((0, 0, 1), yaw)

    def __call__(self, panorama: Panorama, index: int, files: Any = None) -> Panorama:
        """One rotated panorama: RGB bilinear, depth and labels nearest."""
        del files
        rgb, depth, labels, before = panorama
        rotation = self.rotation(index)
        up = rotation[:, 2] if before is None else rotation @ before
        return Panorama(
            rotate_equirect(rgb, rotation, "bilinear"),
            None if depth is None else rotate_equirect(depth, rotation, "nearest"),
            rotate_equirect(labels, rotation, "nearest"),
            up if self._known else None,
        )
