"""The equirectangular image itself as a representation, a baseline."""

from __future__ import annotations

import copy
import math
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import chain
from typing import Any, Self

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tangent_train.errors import SettingError
from tangent_train.geometry import equirect_shape, random_rotation, rotation_about
from tangent_train.registry import registered
from tangent_train.rendering.checks import check_choice, check_count
from tangent_train.rendering.forward import Interpolation, rotate_equirect
from tangent_train.rendering.mosaic import ScoreMosaic
from tangent_train.rendering.representations.perspective import PhotoCrops
from tangent_train.rendering.representations.pinhole import unless_identity
from tangent_train.rendering.representations.views import (
    NOT_ROTATED,
    ManyViews,
    RotationAugmentation,
    Views,
)

Image = NDArray[Any]


@dataclass(frozen=True)
class EquirectViews(Views):
    """The panorama itself.

    Attributes:
        rotation: ``(3, 3)`` rotation of its directions; None for none.
        columns: Start of a crop, as a share of the columns, and its width; None for no crop.
        mirrored: Whether it is mirrored left to right.
        rows: Its rows; None for those of the panorama.
    """

    rotation: NDArray[np.float64] | None = None
    columns: tuple[float, int] | None = None
    mirrored: bool = False
    rows: int | None = None

    def render(self, image: Image, interpolation: Interpolation) -> Image:
        """Render a panorama ``(H, W[, C])`` to one image ``(1, H, w[, C])``, dtype kept."""
        if self.rotation is not None:
            image = rotate_equirect(image, self.rotation.T, interpolation)
        if self.rows not in (None, image.shape[0]):
            image = _resized(image, self.rows, interpolation)
        if self.columns is not None:
            start, width = self.columns
            first = int(start * image.shape[1])
            image = image.take(np.arange(first, first + width), axis=1, mode="wrap")
        if self.mirrored:
            image = image[:, ::-1]
        return np.ascontiguousarray(image[None])

    def rotations(self) -> NDArray[np.float64]:
        """That of the panorama."""
        return NOT_ROTATED if self.rotation is None else self.rotation[None]


def _resized(image: Image, rows: int, interpolation: Interpolation) -> Image:
    """A panorama of other rows: averaged or interpolated, or the pixels at the centres."""
    height = image.shape[0]
    if interpolation == "nearest":
        down, across = ((2 * np.arange(n * rows) + 1) * height // (2 * rows) for n in (1, 2))
        return image[down][:, across]
    method = cv2.INTER_AREA if rows < height else cv2.INTER_LINEAR
    resized: Image = cv2.resize(image, (2 * rows, rows), interpolation=method)
    return resized


def as_crop(scores: Tensor, shape: tuple[int, int]) -> tuple[Tensor, PhotoCrops]:
    """Scores of a whole equirectangular image, to be interpolated on a panorama of another size.

    Args:
        scores: ``(1, K, h, w)``.
        shape: ``(H, W)`` of the panorama.

    Returns:
        The scores continued by a pixel on all sides, around the sphere, and where that lies.
    """
    rows, columns = scores.shape[-2:]
    right, below = shape[1] / columns, shape[0] / rows
    box = np.array([[-right, -below, shape[1] + right, shape[0] + below]])
    first, last = (scores[..., i : i + 1 or None, :].roll(columns // 2, -1) for i in (0, -1))
    tall = torch.cat([first, scores, last], dim=-2)
    framed = torch.cat([tall[..., -1:], tall, tall[..., :1]], dim=-1)
    return framed, PhotoCrops(box, (rows + 2, columns + 2))


def column_shifts(columns: int, count: int) -> list[int]:
    """Columns by which evenly spaced rotations about the vertical shift an equirectangular image.

    Args:
        columns: Of the image.
        count: Number of rotations, 1 or more; none is the first.
    """
    return [round(columns * k / count) for k in range(count)]


@registered
class EquirectRepresentation:
    """The baseline without tangent images: the equirectangular image, or random crops of it.

    Evaluation always uses the whole image.

    Args:
        level: Level s of the panorama.
        crop_deg: Width of the training crops in degrees of longitude, full height, at a random
            longitude and across the seam; the whole image by default.
        rotation: Rotation of the panorama while training; about the vertical by whole columns.
        mirror: Mirror half of the training samples left to right.
        erp_height: Rows of the panorama, default `equirect_shape(level)`.
        rows: Rows of the image that the network sees, default those of the panorama. Its scores are
            interpolated on the panorama.
        average_rotations: Rotations about the vertical that evaluation averages over: each has its
            seam elsewhere.

    Raises:
        SettingError: The crop is no part of the panorama, or there are no rows or rotations.
    """

    def __init__(
        self,
        level: int,
        crop_deg: float | None = None,
        rotation: RotationAugmentation = "none",
        mirror: bool = False,
        erp_height: int | None = None,
        rows: int | None = None,
        average_rotations: int = 1,
    ) -> None:
        if crop_deg is not None and not 0 < crop_deg <= 360:
            raise SettingError("representation.crop_deg", found=crop_deg, expected="0 to 360")
        if rows is not None and rows < 1:
            raise SettingError("representation.rows", found=rows, expected="1 or more, or null")
        check_choice("representation.rotation", rotation, ("none", "yaw", "so3"))
        check_count("representation.average_rotations", average_rotations)
        self.erp_height = equirect_shape(level)[0] if erp_height is None else erp_height
        self.crop_deg = crop_deg
        self.rotation = rotation
        self.mirror = mirror
        self._rows = rows
        self._turn: NDArray[np.float64] | None = None
        self._shifts = column_shifts(self.image_size[1], average_rotations)

    def turned(self, rotation: NDArray[np.float64]) -> Self:
        """The same, looking in rotated directions R·d, instead of a rotation before."""
        turned = copy.copy(self)
        turned._turn = unless_identity(rotation)
        return turned

    @property
    def image_size(self) -> tuple[int, int]:
        """Rows and columns of the image, as evaluated."""
        rows = self._rows or self.erp_height
        return rows, 2 * rows

    def sample(self, rng: np.random.Generator) -> Views:
        """The panorama or one crop of it, optionally rotated."""
        columns = None
        if self.crop_deg is not None or self.rotation == "yaw":
            width = round(self.image_size[1] * (self.crop_deg or 360) / 360)
            columns = (rng.random(), width)
        rotation = self._turn
        if self.rotation == "so3":
            turn = random_rotation(rng).T
            rotation = turn if rotation is None else rotation @ turn
        mirrored = self.mirror and bool(rng.random() < 0.5)
        return EquirectViews(rotation, columns, mirrored, self._rows)

    def whole(self) -> Views:
        """The whole panorama, in every rotation that is averaged over."""
        columns, own = self.image_size[1], np.eye(3) if self._turn is None else self._turn
        turns = (rotation_about((0, 0, 1), 2 * math.pi * n / columns) for n in self._shifts)
        views = [EquirectViews(unless_identity(own @ turn), rows=self._rows) for turn in turns]
        return views[0] if len(views) == 1 else ManyViews(tuple(views))

    def to_labels(
        self, scores: Tensor, shape: tuple[int, int], rotation: NDArray[np.float64] | None = None
    ) -> Tensor:
        """The best class of every pixel; the scores are already those of the rotated panorama."""
        if self._rows is None:
            return _turned_back(scores[0].argmax(dim=0), rotation)
        rotations = NOT_ROTATED if rotation is None else rotation[None]
        return self.to_averaged_labels([scores], shape, rotations).to(scores.device)

    def to_averaged_labels(
        self, scores: Iterable[Tensor], shape: tuple[int, int], rotations: NDArray[np.float64]
    ) -> Tensor:
        """The class with the highest mean probability over all rotations.

        Args:
            scores: ``(1, K, h, w)`` of each of the views of `whole`, or of the first of them.
            shape: ``(H, W)`` of the panorama.
            rotations: Of each of them, see `Views.rotations`.

        Returns:
            Class indices, on the CPU.
        """
        parts = iter(scores)
        first = next(parts)
        mosaic = ScoreMosaic(shape, first.shape[1], "nearest", averaged=len(rotations) > 1)
        shifts = self._shifts[: len(rotations)]
        for one, shift in zip(chain([first], parts), shifts, strict=True):
            mosaic.add_crops(*as_crop(one.roll(shift, -1), shape), np.array([0]))
        return _turned_back(torch.from_numpy(mosaic.labels().astype(np.int64)), rotations[0])


def _turned_back(labels: Tensor, rotation: NDArray[np.float64] | None) -> Tensor:
    """Labels of a rotated panorama as those of the panorama."""
    turn = unless_identity(rotation)
    if turn is None:
        return labels
    small = labels.to(torch.int32).cpu().numpy().astype(np.uint16)
    back = rotate_equirect(small, turn, "nearest").astype(np.int64)
    return torch.from_numpy(back).to(labels.device)
