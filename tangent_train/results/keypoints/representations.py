"""What keypoints are detected on: the panorama, the panorama made smaller, and tangent images."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2

from tangent_train.errors import SettingError
from tangent_train.geometry import TangentGrid, equirect_shape
from tangent_train.keypoints.equirect import detect_on_equirect
from tangent_train.keypoints.tangent import detect_on_tangent_images

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from tangent_train.keypoints.detectors import Detector
    from tangent_train.keypoints.spherical import SphericalKeypoints

__all__ = ["ERP", "LEAST_STEPS", "SHRUNK", "Representations", "shrunk_rows"]

ERP = "ERP"
"""The panorama itself, the paper's baseline."""

SHRUNK = "ERP_shrunk"
"""The panorama with pixels as large as those of tangent images; see `shrunk_rows`."""

LEAST_STEPS = 2
"""Least s − b: smaller tangent images leave parts of the sphere uncovered, see `TangentGrid`."""


def shrunk_rows(level: int) -> int:
    """Rows of a panorama whose pixels are as large as those of tangent images of a level.

    Tangent images have pixels R_v(b−1)/2^(s−b) wide, more than the π/2^(s+1) of the panorama:
    0.709 times as many fit. Fewer, larger pixels show less noise, so that this much of a gain has
    nothing to do with distortion. Base levels 0 and 1 have the same pixels, those of level 2 are
    6 % larger.

    >>> shrunk_rows(10), 2048 * 0.7094
    (1453, 1452.8512)
    """
    return round(math.pi / TangentGrid(0, level).pitch)


@dataclass(frozen=True)
class Representations:
    """The ways in which keypoints of a panorama are detected.

    Attributes:
        base_levels: Of the tangent images.
        detector: Of keypoints.
        margin: Pixels added around every tangent image.
        shrunk: Whether the shrunk panorama is among them.
    """

    base_levels: tuple[int, ...]
    detector: Detector
    margin: int
    shrunk: bool

    @property
    def names(self) -> list[str]:
        """`ERP`, `SHRUNK` if wanted, and ``L0``, ``L1`` … for the base levels."""
        return [ERP, *[SHRUNK] * self.shrunk, *(f"L{b}" for b in self.base_levels)]

    def check_level(self, level: int, reason: str = "") -> None:
        """Make sure that all tangent images exist.

        Args:
            level: Level s.
            reason: Why it is this one, a sentence for the message.

        Raises:
            SettingError: A base level is too great for the level.
        """
        for base_level in self.base_levels:
            if base_level > level - LEAST_STEPS:
                raise SettingError(
                    "base_level",
                    found=base_level,
                    expected=f"at most the level, {level}, less {LEAST_STEPS}",
                    remedy=reason,
                )

    def detect(self, rgb: NDArray[np.uint8], level: int, name: str) -> SphericalKeypoints:
        """Detect keypoints of one panorama.

        Args:
            rgb: ``(H, W, 3)``, not larger than the level; see `at_level`.
            level: Level s.
            name: One of `names`.
        """
        if name == ERP:
            return detect_on_equirect(rgb, self.detector)
        if name == SHRUNK:
            rows = min(shrunk_rows(level), rgb.shape[0])
            return detect_on_equirect(_shrunk(rgb, rows), self.detector)
        grid = TangentGrid(int(name[1:]), level)
        return detect_on_tangent_images(rgb, grid, self.detector, self.margin)


def at_level(rgb: NDArray[np.uint8], level: int) -> NDArray[np.uint8]:
    """A panorama, averaged over areas where it has more rows than the level."""
    rows = equirect_shape(level)[0]
    return rgb if rgb.shape[0] <= rows else _shrunk(rgb, rows)


def _shrunk(rgb: NDArray[np.uint8], rows: int) -> NDArray[np.uint8]:
    return cv2.resize(rgb, (2 * rows, rows), interpolation=cv2.INTER_AREA)
