"""Panoramas that are not upright: turned for a test, and with what is known of where up is."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Literal

from datamodules.core.panoramas import Panorama
from datamodules.core.sampling import sample_rng
from datamodules.core.sources import ImageSource, count_labels
from datamodules.images.gpano import up_of
from tangent_train.geometry import random_rotation, rotation_about
from tangent_train.rendering import rotate_equirect
from tangent_train.rendering.upright.gravity import estimate_up

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from datamodules.core.panoramas import FileSource

__all__ = ["PosedPanoramas", "TurnedPanoramas", "UprightPanoramas"]


class _Wrapped:
    """The panoramas of another source, each with a change."""

    def __init__(self, source: ImageSource[Panorama]) -> None:
        self._source = source

    def __len__(self) -> int:
        return len(self._source)

    def name(self, index: int) -> str:
        """The name in the source."""
        return self._source.name(index)

    def label_counts(self, index: int) -> NDArray[np.int64]:
        """The pixels of every label."""
        return self._source.label_counts(index)


class TurnedPanoramas(_Wrapped):
    """The panoramas of another source as seen by a camera that is not upright.

    The labels turn with the image, so the score is that of the turned panorama. The same panorama
    is turned the same way in every run with the same seed.

    Args:
        source: Where they come from.
        rotation: Tilt in degrees about a random horizontal axis, after a random turn about the
            vertical; or `so3`, uniform over all rotations.
        seed: Seed of the turns.
        known: Whether the panoramas say where up is, as those of a camera with a sensor for it.
    """

    def __init__(
        self,
        source: ImageSource[Panorama],
        rotation: float | Literal["so3"],
        seed: int,
        *,
        known: bool = False,
    ) -> None:
        super().__init__(source)
        self._rotation = rotation
        self._seed = seed
        self._known = known

    def rotation(self, index: int) -> NDArray[np.float64]:
        """The turn of one panorama, ``(3, 3)``: what was seen at d is now seen at R d."""
        rng = sample_rng(self._seed, 0, index)
        if self._rotation == "so3":
            return random_rotation(rng)
        yaw, azimuth = rng.uniform(0, 2 * math.pi, 2)
        tilt = rotation_about(
            (math.cos(azimuth), math.sin(azimuth), 0), math.radians(self._rotation)
        )
        return tilt @ rotation_about((0, 0, 1), yaw)

    def read(self, index: int) -> Panorama:
        """One turned panorama: RGB bilinear, depth and labels nearest."""
        rgb, depth, labels, before = self._source.read(index)
        rotation = self.rotation(index)
        up = rotation[:, 2] if before is None else rotation @ before
        return Panorama(
            rotate_equirect(rgb, rotation, "bilinear"),
            None if depth is None else rotate_equirect(depth, rotation, "nearest"),
            rotate_equirect(labels, rotation, "nearest"),
            up if self._known else None,
        )

    def label_counts(self, index: int) -> NDArray[np.int64]:
        """The pixels of every label of one turned panorama."""
        return count_labels(self.read(index).labels)


class PosedPanoramas(_Wrapped):
    """The panoramas of another source, with what their files say of where up is (GPano).

    Args:
        source: Where they come from.
        files: Their files.
    """

    def __init__(self, source: ImageSource[Panorama], files: FileSource) -> None:
        super().__init__(source)
        self._files = files
        self._ups: dict[int, NDArray[np.float64] | None] = {}

    def read(self, index: int) -> Panorama:
        """One panorama; `up` is None where its file does not say it."""
        if index not in self._ups:
            self._ups[index] = up_of(self._files.files(index)["rgb"])
        return self._source.read(index)._replace(up=self._ups[index])


class UprightPanoramas(_Wrapped):
    """The panoramas of another source, with an estimate of where up is for those that do not say.

    They are looked at upright, whatever way the camera was held; their pixels and labels stay where
    they are.

    Args:
        source: Where they come from.
        max_tilt_deg: The most they may be tilted, see `estimate_up`.
    """

    def __init__(self, source: ImageSource[Panorama], max_tilt_deg: float) -> None:
        super().__init__(source)
        self._max_tilt_deg = max_tilt_deg
        self._ups: dict[int, NDArray[np.float64] | None] = {}

    def read(self, index: int) -> Panorama:
        """One panorama; `up` is None where nothing says it."""
        panorama = self._source.read(index)
        if panorama.up is not None:
            return panorama
        if index not in self._ups:
            self._ups[index] = estimate_up(panorama.rgb, self._max_tilt_deg).found
        return panorama._replace(up=self._ups[index])
