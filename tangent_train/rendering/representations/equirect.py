"""The equirectangular image itself as a representation: a baseline for tangent images."""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tangent_train.errors import SettingError, at_least
from tangent_train.geometry import (
    SphereArea,
    equirect_directions,
    equirect_latitudes,
    equirect_longitudes,
    equirect_shape,
    lonlat_to_equirect,
    lonlat_to_xyz,
    random_rotation,
    xyz_to_lonlat,
)
from tangent_train.registry import registered
from tangent_train.rendering.checks import Blend, check_choice
from tangent_train.rendering.forward import Interpolation, Pixels, rotate_equirect
from tangent_train.rendering.representations.perspective import PhotoCrops
from tangent_train.rendering.representations.pinhole import unless_identity
from tangent_train.rendering.representations.views import (
    RotationAugmentation,
    Views,
)
from tangent_train.rendering.resampling import resize

_STRIDE = 32
"""Parts of panoramas have a multiple of this many rows and columns: the stride of most networks."""

_FINE_ROWS = 128


@dataclass(frozen=True, eq=False)
class EquirectViews(Views):
    """The panorama itself, one view.

    Attributes:
        rotation: ``(3, 3)`` rotation of its directions; None for the identity.
        first: First column of the view.
        width: Number of columns of the view; None for all.
        mirrored: True if the view is mirrored left to right.
        rows: Rows to which the panorama is resized; None to keep its size.
        top: First row of the view.
        height: Number of rows of the view; None for all.
    """

    rotation: NDArray[np.float64] | None = None
    first: int = 0
    width: int | None = None
    mirrored: bool = False
    rows: int | None = None
    top: int = 0
    height: int | None = None

    def __len__(self) -> int:
        return 1

    def __getitem__(self, part: slice) -> Self:
        """Return the view itself."""
        return self

    def render(self, image: Pixels, interpolation: Interpolation) -> Pixels:
        """See `Views`."""
        shown: Any = image
        if self.rotation is not None:
            shown = rotate_equirect(shown, self.rotation.T, interpolation)
        if self.rows is not None:
            shown = resize(shown, (self.rows, 2 * self.rows), interpolation)
        if isinstance(image, Tensor):
            columns: Any = shown.roll(-self.first, -1)[None, ..., self._lines, : self.width]
            return columns.flip(-1) if self.mirrored else columns
        shown = shown[self._lines]
        if self.first or self.width is not None:
            stop = self.first + (self.width or shown.shape[1])
            shown = shown.take(np.arange(self.first, stop), axis=1, mode="wrap")
        if self.mirrored:
            shown = shown[:, ::-1]
        view: Any = np.ascontiguousarray(shown[None])
        return view

    @property
    def _lines(self) -> slice:
        return slice(self.top, None if self.height is None else self.top + self.height)

    def placed(self, scores: Tensor, shape: tuple[int, int]) -> tuple[Tensor, Views]:
        """Return the scores of the unrotated panorama, extended by a pixel on all sides."""
        scores = self._extended(scores)
        scores = scores.roll(self.first, -1)
        if self.rotation is not None:
            scores = rotate_equirect(scores, self.rotation)
        rows, columns = scores.shape[-2:]
        beyond = (scores[..., i : i + 1 or None, :].roll(columns // 2, -1) for i in (0, -1))
        above, below = beyond
        tall = torch.cat([above, scores, below], dim=-2)
        framed = torch.cat([tall[..., -1:], tall, tall[..., :1]], dim=-1)
        x, y = shape[1] / columns, shape[0] / rows
        box = np.array([[-x, -y, shape[1] + x, shape[0] + y]])
        return framed, PhotoCrops(box, (rows + 2, columns + 2), is_overlapping=False)

    def _extended(self, scores: Tensor) -> Tensor:
        """Return scores ``(…, h, w)`` of a part of the panorama repeated to all of it."""
        if self.rows is None or scores.shape[-2:] == (self.rows, 2 * self.rows):
            return scores
        rows, columns = scores.shape[-2:]
        down = (torch.arange(self.rows) - self.top).clamp(0, rows - 1)
        across = torch.arange(2 * self.rows)
        across = across.where(across < self.rows + columns // 2, across - 2 * self.rows)
        return scores[..., down[:, None], across.clamp(0, columns - 1)]


@registered
class EquirectRepresentation:
    """The baseline without tangent images: the equirectangular image, or random crops of it.

    Evaluation always uses the whole image, or the rows and columns that show the area of a partial
    panorama.

    Args:
        level: Level s of the panorama.
        crop_deg: Width of the training crops in degrees of longitude, full height, at a random
            longitude and across the seam; the whole image by default.
        random_rotation: Rotation of the panorama in training; `yaw` rotates by whole columns.
        mirror: True to mirror half of the training samples left to right.
        erp_height: Rows of the panorama, default `equirect_shape(level)`.
        rows: Rows of the network's input, default those of the panorama. Its scores are
            interpolated to the panorama.
        rotations: Number of rotations about the vertical to average over. Each has its seam at
            another longitude.

    Raises:
        SettingError: `crop_deg` is not between 0 and 360, or `rows` or `rotations` is less than 1.
    """

    blend: Blend = "nearest"

    def __init__(
        self,
        level: int,
        crop_deg: float | None = None,
        random_rotation: RotationAugmentation = "none",
        mirror: bool = False,
        erp_height: int | None = None,
        rows: int | None = None,
        rotations: int = 1,
    ) -> None:
        if crop_deg is not None and not 0 < crop_deg <= 360:
            raise SettingError("representation.crop_deg", found=crop_deg, expected="0 to 360")
        if rows is not None:
            at_least("representation.rows", rows, 1)
        choices = ("none", "yaw", "so3")
        check_choice("representation.random_rotation", random_rotation, choices)
        at_least("representation.rotations", rotations, 1)
        self.erp_height = equirect_shape(level)[0] if erp_height is None else erp_height
        self.crop_deg = crop_deg
        self.random_rotation = random_rotation
        self.mirror = mirror
        self._rows = rows or self.erp_height
        self._rotation: NDArray[np.float64] | None = None
        self._area: SphereArea | None = None
        columns = 2 * self._rows
        self._first_columns = [round(columns * k / rotations) for k in range(rotations)]

    def with_rotation(self, rotation: NDArray[np.float64]) -> Self:
        """Return the same representation in rotated directions R·d."""
        rotated = copy.copy(self)
        rotated._rotation = unless_identity(rotation)
        return rotated

    def limited_to(self, area: SphereArea | None) -> Self:
        """Return the same representation with only the rows and columns that show an area.

        Their numbers are rounded up to a multiple of 32 (of a divisor of `rows`). Under rotation,
        evaluation takes as many as needed, and a training sample as many as without rotation,
        where they see most of the area.
        """
        limited = copy.copy(self)
        limited._area = None if area is None or area.is_whole else area
        return limited

    @property
    def image_size(self) -> tuple[int, int]:
        """Rows and columns of the image of an unrotated panorama in evaluation."""
        window = _Window.whole(self._rows)
        if self._area is not None:
            window = _resting_window(self._area.angles, self._rows)
        return window.height, window.width

    def sample(self, rng: np.random.Generator) -> EquirectViews:
        """Return the panorama or a random crop of it, optionally rotated."""
        rotation, columns, shift = self._rotation, 2 * self._rows, None
        if self.crop_deg is not None or self.random_rotation == "yaw":
            shift = rng.random()
        if self.random_rotation == "so3":
            drawn = random_rotation(rng).T
            rotation = drawn if rotation is None else rotation @ drawn
        window = self._window(rotation, self.image_size)
        if shift is not None:
            width = min(window.width, round(columns * (self.crop_deg or 360) / 360))
            starts = columns if window.width == columns else window.width - width + 1
            window = replace(window, first=window.first + int(shift * starts), width=width)
        mirrored = self.mirror and bool(rng.random() < 0.5)
        return self._views(rotation, window, mirrored=mirrored)

    def view_sets(self) -> list[EquirectViews]:
        """Return the whole panorama, or its part that shows the area, in every rotation."""
        window = self._window(self._rotation)
        # A part has its edges at the same longitudes in every rotation.
        shifts = self._first_columns if window.width == 2 * self._rows else [0]
        windows = (replace(window, first=window.first + shift) for shift in shifts)
        return [self._views(self._rotation, shifted) for shifted in windows]

    def _window(
        self, rotation: NDArray[np.float64] | None, size: tuple[int, int] | None = None
    ) -> _Window:
        """Return the part of the rotated panorama that is rendered, see `limited_to`.

        Args:
            rotation: See `EquirectViews`.
            size: Rows and columns in training.
        """
        if self._area is None:
            return _Window.whole(self._rows)
        area = self._area if rotation is None else self._area.rotated(rotation.T)
        if area.rotation is None:
            return _resting_window(area.angles, self._rows)
        return _find_window(area, self._rows, size)

    def _views(
        self, rotation: NDArray[np.float64] | None, window: _Window, *, mirrored: bool = False
    ) -> EquirectViews:
        columns = 2 * self._rows
        width = window.width if window.width < columns else None
        first = window.first % columns
        return EquirectViews(
            rotation, first, width, mirrored, self._rows, window.top, window.height
        )


@dataclass(frozen=True)
class _Window:
    """A part of an equirectangular image, which may continue across its right edge."""

    top: int
    height: int
    first: int
    width: int

    @classmethod
    def whole(cls, rows: int) -> Self:
        return cls(0, rows, 0, 2 * rows)


@lru_cache(maxsize=16)
def _resting_window(angles: tuple[float, ...], rows: int) -> _Window:
    return _find_window(SphereArea.of(angles), rows)


def _find_window(area: SphereArea, rows: int, size: tuple[int, int] | None = None) -> _Window:
    """Return the smallest window that shows an area, or the one of a given size that shows most.

    Args:
        area: The area, in the frame of the image.
        rows: Rows of the image.
        size: Rows and columns of the window.
    """
    middle = np.radians((area.west + area.width_deg / 2, (area.south + area.north) / 2))
    shape, beyond = (rows, 2 * rows), 0
    if area.rotation is None:
        latitudes, longitudes = equirect_latitudes(rows), equirect_longitudes(2 * rows)
        lines = (
            np.broadcast_arrays(middle[0], latitudes),
            np.broadcast_arrays(longitudes, middle[1]),
        )
        counts = [area.contains(lonlat_to_xyz(np.stack(line, -1))).astype(int) for line in lines]
        center = middle
    else:  # found in steps, to save time
        beyond = max((k for k in range(1, rows // _FINE_ROWS + 1) if rows % k == 0), default=1)
        seen = area.contains(equirect_directions((rows // beyond, 2 * rows // beyond)))
        counts = [seen.sum(axis=axis).repeat(beyond) for axis in (1, 0)]
        center = xyz_to_lonlat(area.rotation @ lonlat_to_xyz(middle))
    pixel = lonlat_to_equirect(center, shape)[::-1].round().astype(int) % shape
    runs = []
    for axis, of_axis in enumerate(counts):
        of_axis[pixel[axis]] += 1  # areas may be smaller than a pixel
        length = None if size is None else size[axis]
        runs.append(_run(of_axis, beyond, math.gcd(rows, _STRIDE), length, axis))
    (top, height), (first, width) = runs
    return _Window(min(max(top, 0), rows - height), height, first, width)


def _run(
    counts: NDArray[np.int64], beyond: int, multiple: int, length: int | None, axis: int
) -> tuple[int, int]:
    """Return start and length of a run of rows or columns; columns continue across the end.

    Args:
        counts: Pixels of the area in each row or column.
        beyond: Lines added on both sides.
        multiple: The length is a multiple of this.
        length: Length of the run that contains as many pixels as possible; None for the shortest
            run that contains all.
        axis: 0 for rows, 1 for columns.
    """
    total, lines = len(counts), np.flatnonzero(counts)
    gaps = np.diff(lines, append=lines[0] + total)
    widest = int(gaps.argmax())
    needed = total - int(gaps[widest]) + 1 + 2 * beyond
    start = int(lines[(widest + 1) % len(lines)]) - beyond
    if length is None:
        length = min(total, -(-needed // multiple) * multiple)
    elif length < needed:
        sums = np.cumsum(np.concatenate([[0], counts, axis * counts]))
        return int((sums[length:-1] - sums[: -length - 1])[:total].argmax()), length
    return (0 if length == total else start - (length - needed) // 2), length
