"""The equirectangular image itself as a representation: a baseline for tangent images."""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass
from typing import Any, NamedTuple, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tangent_train.errors import SettingError, at_least
from tangent_train.geometry import (
    SphereArea,
    equirect_directions,
    equirect_shape,
    random_rotation,
)
from tangent_train.rendering.checks import Blend, check_choice
from tangent_train.rendering.forward import Interpolation, Pixels, rotate_equirect
from tangent_train.rendering.representations.perspective import PhotoCrops
from tangent_train.rendering.representations.pinhole import unless_identity
from tangent_train.rendering.representations.views import STRIDE, RotationAugmentation, Views
from tangent_train.rendering.resampling import resize

_FINE_ROWS = 128


class Window(NamedTuple):
    """A part of an equirectangular image, which may continue across its right edge."""

    top: int
    height: int
    first: int
    width: int


@dataclass(frozen=True, eq=False)
class EquirectViews(Views):
    """The panorama itself or a part of it, one view.

    Attributes:
        rotation: ``(3, 3)`` rotation of its directions; None for the identity.
        rows: Rows to which the panorama is resized.
        window: The part that is shown.
        mirrored: True if the view is mirrored left to right.
    """

    rotation: NDArray[np.float64] | None
    rows: int
    window: Window
    mirrored: bool = False

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
        shown = resize(shown, (self.rows, 2 * self.rows), interpolation)
        top, height, first, width = self.window
        lines = slice(top, top + height)
        if isinstance(image, Tensor):
            columns: Any = shown.roll(-first, -1)[None, ..., lines, :width]
            return columns.flip(-1) if self.mirrored else columns
        shown = shown[lines]
        if (first, width) != (0, 2 * self.rows):
            shown = shown.take(np.arange(first, first + width), axis=1, mode="wrap")
        if self.mirrored:
            shown = shown[:, ::-1]
        view: Any = np.ascontiguousarray(shown[None])
        return view

    def on_canvas(self, scores: Tensor, shape: tuple[int, int]) -> tuple[Tensor, Views]:
        """Return the scores of the unrotated panorama, extended by a pixel on all sides."""
        scores = self._extended(scores).roll(self.window.first, -1)
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
        top, height, _, width = self.window
        columns = 2 * self.rows
        if (height, width) == (self.rows, columns):
            return scores
        down = (torch.arange(self.rows) - top).clamp(0, height - 1)
        across = torch.arange(columns)
        across = across.where(across < (columns + width) // 2, across - columns)
        return scores[..., down[:, None], across.clamp(0, width - 1)]


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
        distortion_aware: True to sample the convolutions of the network on the sphere, see
            `models.make_distortion_aware`. The image is then always a whole one.

    Raises:
        SettingError: `crop_deg` is not between 0 and 360, or is given with `distortion_aware`;
            `rows` or `rotations` is less than 1.
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
        distortion_aware: bool = False,
    ) -> None:
        if crop_deg is not None and distortion_aware:
            found = f"{crop_deg}, with distortion_aware"
            raise SettingError("representation.crop_deg", found=found, expected="null: all of it")
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
        self.distortion_aware = distortion_aware
        self._rows = rows or self.erp_height
        self._rotation: NDArray[np.float64] | None = None
        self._area = SphereArea.of(None)
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
        where they see most of the area. With `distortion_aware`, all of them are kept.
        """
        limited = copy.copy(self)
        limited._area = SphereArea.of(None) if area is None or self.distortion_aware else area
        return limited

    @property
    def image_size(self) -> tuple[int, int]:
        """Rows and columns of the image of an unrotated panorama in evaluation."""
        window = _resting_window(self._area, self._rows)
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
            window = window._replace(first=window.first + int(shift * starts), width=width)
        return EquirectViews(rotation, self._rows, window, self.mirror and bool(rng.random() < 0.5))

    def view_sets(self) -> list[EquirectViews]:
        """Return the whole panorama, or its part that shows the area, in every rotation."""
        window = self._window(self._rotation)
        # A part has its edges at the same longitudes in every rotation.
        shifts = self._first_columns if window.width == 2 * self._rows else [0]
        windows = (window._replace(first=window.first + shift) for shift in shifts)
        return [EquirectViews(self._rotation, self._rows, shifted) for shifted in windows]

    def _window(
        self, rotation: NDArray[np.float64] | None, size: tuple[int, int] | None = None
    ) -> Window:
        """Return the part of the rotated panorama that is rendered, see `limited_to`.

        Args:
            rotation: See `EquirectViews`.
            size: Rows and columns in training.
        """
        area = self._area if rotation is None else self._area.rotated(rotation.T)
        if area.rotation is None or area.is_whole:
            return _resting_window(area, self._rows)
        return _rotated_window(area, self._rows, size)


def _resting_window(area: SphereArea, rows: int) -> Window:
    """Return the smallest window that shows an area; its rotation is ignored."""
    edges = np.array([[90 - area.north, area.west + 180], [90 - area.south, 0]])
    edges[1, 1] = edges[0, 1] + area.width_deg
    start, stop = np.round(edges * rows / 180).astype(int)
    needed = np.maximum(stop - start, 1)
    multiple = math.gcd(rows, STRIDE)
    height, width = np.minimum(-(-needed // multiple) * multiple, (rows, 2 * rows)).tolist()
    top, first = (start - ((height, width) - needed) // 2).tolist()
    top = min(max(top, 0), rows - height)
    return Window(top, height, 0 if width == 2 * rows else first, width)


def _rotated_window(area: SphereArea, rows: int, size: tuple[int, int] | None) -> Window:
    """Return the smallest window that shows an area, or the one of a given size that shows most.

    Args:
        area: The area, in the frame of the image.
        rows: Rows of the image.
        size: Rows and columns of the window; None for the smallest.
    """
    step = max((k for k in range(1, rows // _FINE_ROWS + 1) if rows % k == 0), default=1)
    seen = area.contains(equirect_directions((rows // step, 2 * rows // step)))
    multiple, runs = math.gcd(rows, STRIDE), []
    for axis, mode in enumerate(("constant", "wrap")):
        counts = seen.sum(axis=1 - axis)
        # Cells beside those whose center is in the area may contain a bit of it.
        beside = np.pad(counts > 0, 1, mode=mode)  # type: ignore[call-overload]
        counts = (counts + (beside[2:] | beside[:-2])).repeat(step)
        if size is None:
            lines = np.flatnonzero(counts)
            gap = np.diff(lines, append=lines[:1] + len(counts)).max(initial=0)
            length = min(len(counts), -(-(len(counts) - gap + 1) // multiple) * multiple)
        else:
            length = size[axis]
        around = counts if axis == 0 else np.concatenate([counts, counts[: length - 1]])
        sums = np.convolve(around, np.ones(length, int), "valid")
        best = np.flatnonzero(sums == sums.max())
        runs += [0 if length == len(counts) else int(best[len(best) // 2]), int(length)]
    return Window(*runs)
