"""The equirectangular image itself as a representation, a baseline."""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tangent_train.errors import SettingError
from tangent_train.geometry import equirect_shape, random_rotation
from tangent_train.registry import registered
from tangent_train.rendering.checks import check_choice
from tangent_train.rendering.forward import Interpolation
from tangent_train.rendering.representations.pinhole import unless_identity
from tangent_train.rendering.representations.views import (
    NO_RAYS,
    NOT_ROTATED,
    RotationAugmentation,
    Views,
)
from tangent_train.rendering.rotate import rotate_equirect

__all__ = ["EquirectRepresentation", "EquirectViews"]

Image = NDArray[Any]


@dataclass(frozen=True)
class EquirectViews:
    """The panorama itself.

    Attributes:
        rotation: ``(3, 3)`` rotation of its directions; None for none.
        columns: Start of a crop, as a share of the columns, and its width; None for no crop.
        mirrored: Whether it is mirrored left to right.
    """

    rotation: NDArray[np.float64] | None = None
    columns: tuple[float, int] | None = None
    mirrored: bool = False

    def render(self, image: Image, interpolation: Interpolation) -> Image:
        """Render a panorama ``(H, W[, C])`` to one image ``(1, H, w[, C])``, dtype kept."""
        if self.rotation is not None:
            image = rotate_equirect(image, self.rotation.T, interpolation)
        if self.columns is not None:
            start, width = self.columns
            first = int(start * image.shape[1])
            image = image.take(np.arange(first, first + width), axis=1, mode="wrap")
        if self.mirrored:
            image = image[:, ::-1]
        return np.ascontiguousarray(image[None])

    def rays(self) -> NDArray[np.float32]:
        """None: this is no pinhole image."""
        return NO_RAYS

    def rotations(self) -> NDArray[np.float64]:
        """That of the panorama."""
        return NOT_ROTATED if self.rotation is None else self.rotation[None]


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

    Raises:
        SettingError: The crop is no part of the panorama.
    """

    def __init__(
        self,
        level: int,
        crop_deg: float | None = None,
        rotation: RotationAugmentation = "none",
        mirror: bool = False,
        erp_height: int | None = None,
    ) -> None:
        if crop_deg is not None and not 0 < crop_deg <= 360:
            raise SettingError("representation.crop_deg", found=crop_deg, expected="0 to 360")
        check_choice("representation.rotation", rotation, ("none", "yaw", "so3"))
        self.erp_height = equirect_shape(level)[0] if erp_height is None else erp_height
        self.crop_deg = crop_deg
        self.rotation = rotation
        self.mirror = mirror
        self._turn: NDArray[np.float64] | None = None

    def turned(self, rotation: NDArray[np.float64]) -> Self:
        """The same, looking in rotated directions R·d, instead of a rotation before."""
        turned = copy.copy(self)
        turned._turn = unless_identity(rotation)
        return turned

    @property
    def image_size(self) -> tuple[int, int]:
        """Rows and columns of the panorama, as evaluated."""
        return self.erp_height, 2 * self.erp_height

    def sample(self, rng: np.random.Generator) -> Views:
        """The panorama or one crop of it, optionally rotated."""
        columns = None
        if self.crop_deg is not None or self.rotation == "yaw":
            width = round(2 * self.erp_height * (self.crop_deg or 360) / 360)
            columns = (rng.random(), width)
        rotation = self._turn
        if self.rotation == "so3":
            turn = random_rotation(rng).T
            rotation = turn if rotation is None else rotation @ turn
        return EquirectViews(rotation, columns, self.mirror and bool(rng.random() < 0.5))

    def whole(self) -> Views:
        """The whole panorama."""
        return EquirectViews(self._turn)

    def to_labels(
        self, scores: Tensor, shape: tuple[int, int], rotation: NDArray[np.float64] | None = None
    ) -> Tensor:
        """The best class of every pixel; the scores are already those of the rotated panorama."""
        del shape
        labels = scores[0].argmax(dim=0)
        turn = unless_identity(rotation)
        if turn is None:
            return labels
        small = labels.to(torch.int32).cpu().numpy().astype(np.uint16)
        back = rotate_equirect(small, turn, "nearest").astype(np.int64)
        return torch.from_numpy(back).to(labels.device)
