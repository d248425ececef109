"""The equirectangular image itself as a representation: a baseline for tangent images."""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from tangent_train.errors import SettingError, at_least, check_choice
from tangent_train.geometry import MOST_ROWS, panorama_rows, random_rotation
from tangent_train.kinds import MOST_ROTATIONS
from tangent_train.rendering.forward import Blend, rotate_equirect
from tangent_train.rendering.representations.perspective import PhotoCrops
from tangent_train.rendering.representations.pinhole import unless_identity
from tangent_train.rendering.representations.views import RotationAugmentation, Views
from tangent_train.rendering.resampling import Interpolation, Pixels, resize
from tangent_train.rendering.tensors import with_frame


@dataclass(frozen=True, eq=False)
class EquirectViews(Views):
    """The panorama itself or a crop of full height, one view.

    Attributes:
        rotation: ``(3, 3)`` rotation of its directions; None for the identity.
        rows: Rows to which the panorama is resized.
        first: First column that is shown.
        width: Number of columns, which may continue across the right edge.
        mirrored: True if the view is mirrored left to right.
    """

    rotation: NDArray[np.float64] | None
    rows: int
    first: int
    width: int
    mirrored: bool = False

    def render(self, image: Pixels, interpolation: Interpolation) -> Pixels:
        """See `Views`."""
        shown: Any = image
        if self.rotation is not None:
            shown = rotate_equirect(shown, self.rotation.T, interpolation)
        shown = resize(shown, (self.rows, 2 * self.rows), interpolation)
        if isinstance(image, Tensor):
            columns: Any = shown.roll(-self.first, -1)[None, ..., : self.width]
            return columns.flip(-1) if self.mirrored else columns
        if (self.first, self.width) != (0, 2 * self.rows):
            columns = np.arange(self.first, self.first + self.width)
            shown = shown.take(columns, axis=1, mode="wrap")
        if self.mirrored:
            shown = shown[:, ::-1]
        view: Any = np.ascontiguousarray(shown[None])
        return view

    def on_canvas(self, scores: Tensor, shape: tuple[int, int]) -> tuple[Tensor, Views]:
        """Return the scores of the unrotated panorama, extended by a pixel on all sides."""
        scores = scores.roll(self.first, -1)
        if self.rotation is not None:
            scores = rotate_equirect(scores, self.rotation)
        rows, columns = scores.shape[-2:]
        x, y = shape[1] / columns, shape[0] / rows
        box = np.array([[-x, -y, shape[1] + x, shape[0] + y]])
        return with_frame(scores), PhotoCrops(box, (rows + 2, columns + 2), is_overlapping=False)


class EquirectRepresentation:
    """The baseline without tangent images: the equirectangular image, or random crops of it.

    Evaluation always uses the whole image, of a partial panorama too.

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
            at_least("representation.rows", rows, 1, MOST_ROWS)
        choices = ("none", "yaw", "so3")
        check_choice("representation.random_rotation", random_rotation, choices)
        at_least("representation.rotations", rotations, 1, MOST_ROTATIONS)
        self.erp_height = panorama_rows(level, erp_height)
        self.crop_deg = crop_deg
        self.random_rotation = random_rotation
        self.mirror = mirror
        self.distortion_aware = distortion_aware
        self._rows = rows or self.erp_height
        self._rotation: NDArray[np.float64] | None = None
        columns = 2 * self._rows
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

    def sample(
        self, rng: np.random.Generator, valid: NDArray[np.bool_] | None = None
    ) -> EquirectViews:
        """Return the panorama or a random crop of it, optionally rotated.

        A crop of a partial panorama is centered on a column with valid pixels, unless it is rotated
        by more than `yaw`.
        """
        rotation, columns, first = self._rotation, 2 * self._rows, 0
        width = round(columns * (self.crop_deg or 360) / 360)
        if self.crop_deg is not None or self.random_rotation == "yaw":
            first = int(rng.random() * columns)
            if valid is not None and self.crop_deg is not None and rotation is None:
                seen = np.flatnonzero(valid.any(axis=0))
                center = seen[first * len(seen) // columns] * columns // valid.shape[1]
                first = int(center - width // 2) % columns
        if self.random_rotation == "so3":
            drawn = random_rotation(rng).T
            rotation = drawn if rotation is None else rotation @ drawn
        mirrored = self.mirror and bool(rng.random() < 0.5)
        return EquirectViews(rotation, self._rows, first, width, mirrored)

    def view_sets(self, valid: NDArray[np.bool_] | None = None) -> list[EquirectViews]:
        """Return the whole panorama in every rotation about the vertical."""
        del valid
        columns = 2 * self._rows
        return [EquirectViews(self._rotation, self._rows, k, columns) for k in self._first_columns]
