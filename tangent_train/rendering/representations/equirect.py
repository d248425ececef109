"""The equirectangular image itself as a representation: a baseline for tangent images."""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tangent_train.errors import SettingError, at_least
from tangent_train.geometry import equirect_shape, random_rotation
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


@dataclass(frozen=True, eq=False)
class EquirectViews(Views):
    """The panorama itself, one view.

    Attributes:
        rotation: ``(3, 3)`` rotation of its directions; None for the identity.
        first: First column of the view.
        width: Number of columns of the view; None for all.
        mirrored: True if the view is mirrored left to right.
        rows: Rows to which the panorama is resized; None to keep its size.
    """

    rotation: NDArray[np.float64] | None = None
    first: int = 0
    width: int | None = None
    mirrored: bool = False
    rows: int | None = None

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
            columns: Any = shown.roll(-self.first, -1)[None, ..., : self.width]
            return columns.flip(-1) if self.mirrored else columns
        if self.first or self.width is not None:
            stop = self.first + (self.width or shown.shape[1])
            shown = shown.take(np.arange(self.first, stop), axis=1, mode="wrap")
        if self.mirrored:
            shown = shown[:, ::-1]
        view: Any = np.ascontiguousarray(shown[None])
        return view

    def placed(self, scores: Tensor, shape: tuple[int, int]) -> tuple[Tensor, Views]:
        """Return the scores of the unrotated panorama, extended by a pixel on all sides."""
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


@registered
class EquirectRepresentation:
    """The baseline without tangent images: the equirectangular image, or random crops of it.

    Evaluation always uses the whole image.

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
        columns = self.image_size[1]
        self._first_columns = [round(columns * k / rotations) for k in range(rotations)]

    def with_rotation(self, rotation: NDArray[np.float64]) -> Self:
        """Return the same representation in rotated directions R·d."""
        rotated = copy.copy(self)
        rotated._rotation = unless_identity(rotation)
        return rotated

    @property
    def image_size(self) -> tuple[int, int]:
        """Rows and columns of the image in evaluation."""
        return self._rows, 2 * self._rows

    def sample(self, rng: np.random.Generator) -> EquirectViews:
        """Return the panorama or a random crop of it, optionally rotated."""
        first, width, columns = 0, None, self.image_size[1]
        if self.crop_deg is not None or self.random_rotation == "yaw":
            first, width = (
                int(rng.random() * columns),
                round(columns * (self.crop_deg or 360) / 360),
            )
        rotation = self._rotation
        if self.random_rotation == "so3":
            drawn = random_rotation(rng).T
            rotation = drawn if rotation is None else rotation @ drawn
        mirrored = self.mirror and bool(rng.random() < 0.5)
        return EquirectViews(rotation, first, width, mirrored, self._rows)

    def view_sets(self) -> list[EquirectViews]:
        """Return the whole panorama in every rotation."""
        rotation, rows = self._rotation, self._rows
        return [EquirectViews(rotation, first, rows=rows) for first in self._first_columns]
