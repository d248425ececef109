"""What a network sees of a panorama, and how its scores become labels of the panorama again.

A *representation* turns panoramas into images a network can take: tangent images, or, as honest
baselines, the faces of a cube, the equirectangular image itself or crops of it. It draws the
*views* of one training sample (which images, turned and mirrored how), gives the views of the whole
sphere for evaluation, and assembles the scores of the latter. Data modules and tasks know nothing
else about it.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Iterable
from typing import Any, Literal, Protocol, Self, TypeVar, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float, Integer
from numpy.typing import NDArray
from torch import Tensor

from tangent_train.errors import SettingError
from tangent_train.geometry import (
    PinholeGrid,
    TangentGrid,
    equirect_shape,
    random_rotation,
    rotation_about,
)
from tangent_train.registry import registered
from tangent_train.rendering.backward import Blend, tangent_to_labels
from tangent_train.rendering.mosaic import ScoreMosaic
from tangent_train.rendering.representations.views import (
    EquirectViews,
    ManyViews,
    PinholeViews,
    Views,
)
from tangent_train.rendering.rotate import rotate_equirect

__all__ = [
    "Assembler",
    "EquirectRepresentation",
    "PinholeRepresentation",
    "Representation",
    "RotationAugmentation",
    "Sampler",
    "TangentRepresentation",
    "Views",
    "spun",
    "turns",
]

RotationAugmentation = Literal["none", "yaw", "so3"]
"""How training panoramas are turned: not, about the vertical, or any way."""

_SYMMETRY_DEG = 72.0
"""The icosahedron looks the same after this turn about the vertical."""

_Choice = TypeVar("_Choice", bound=str)
_Grid = TypeVar("_Grid", bound=PinholeGrid)


class Sampler(Protocol):
    """What draws views."""

    def sample(self, rng: np.random.Generator) -> Views:
        """Views of one training sample: a random subset, augmented."""
        ...

    def whole(self) -> Views:
        """Views of the whole panorama or photo, in a fixed order."""
        ...


@runtime_checkable
class Assembler(Protocol):
    """What becomes of scores: all that a task knows of a representation."""

    @property
    def image_size(self) -> tuple[int, int]:
        """Rows and columns of the images."""
        ...

    def to_labels(
        self, scores: Tensor, shape: Any, rotation: NDArray[np.float64] | None = None
    ) -> Tensor:
        """Class indices of the shape of the truth, from the scores of all images."""
        ...


@runtime_checkable
class Representation(Sampler, Assembler, Protocol):
    """What a network sees of a panorama."""

    @property
    def erp_height(self) -> int:
        """Rows of the panorama it reads and is scored on."""
        ...

    def turned(self, rotation: NDArray[np.float64]) -> Self:
        """The same, looking in turned directions R·d: what panoramas that are not upright need."""
        ...

    def to_labels(
        self,
        scores: Float[Tensor, "images classes height width"],
        shape: tuple[int, int],
        rotation: NDArray[np.float64] | None = None,
    ) -> Integer[Tensor, "rows columns"]:
        """Class index of every pixel of the panorama.

        Args:
            scores: Of all images of `whole`, those of one turn.
            shape: ``(H, W)`` of the panorama.
            rotation: Of the views, one of `Views.rotations`; None where they are not turned.
        """
        ...


class PinholeRepresentation:
    """Pinhole images around the centre: what tangent images and the faces of a cube share.

    Args:
        grid: The images, not turned.
        level: Level s of the panorama.
        rotation: Rotation of the images as a whole while training.
        mirror: Mirror half of the training samples left to right.
        erp_height: Rows of the panorama, default `equirect_shape(level)`.
        blend: How overlapping images are joined in evaluation.
        faces_per_panorama: Images drawn at random for a training sample; all by default.

    Raises:
        SettingError: A value is impossible.
    """

    def __init__(
        self,
        grid: PinholeGrid,
        level: int,
        rotation: RotationAugmentation,
        mirror: bool,
        erp_height: int | None,
        blend: Blend = "nearest",
        faces_per_panorama: int | None = None,
    ) -> None:
        self.grid = grid
        self.rotation = _checked_choice("rotation", rotation, ("none", "yaw", "so3"))
        self.mirror = mirror
        self.erp_height = _erp_height(erp_height, level)
        self.blend = _checked_choice("blend", blend, ("nearest", "feather"))
        self.faces_per_panorama = faces_per_panorama

    @property
    def image_size(self) -> tuple[int, int]:
        """Rows and columns of the images."""
        return self.grid.dim, self.grid.dim

    def turned(self, rotation: NDArray[np.float64]) -> Self:
        """The same with the images turned as a whole, R·d; instead of a turn before."""
        turned = copy.copy(self)
        turned.grid = self.grid.with_rotation(_unless_identity(rotation))
        return turned

    def sample(self, rng: np.random.Generator) -> Views:
        """All images or a random subset, (perhaps) turned as a whole and mirrored one by one."""
        grid = self.grid
        if self.rotation != "none":
            yaw = self.rotation == "yaw"
            angle = rng.uniform(0, 2 * math.pi)
            turn = rotation_about((0, 0, 1), angle) if yaw else random_rotation(rng)
            grid = spun(grid, turn)
        faces = None
        if self.faces_per_panorama is not None:
            faces = rng.choice(grid.num_images, self.faces_per_panorama, replace=False)
        return PinholeViews(grid, faces, self.mirror and bool(rng.random() < 0.5))

    def whole(self) -> Views:
        """All images."""
        return PinholeViews(self.grid)

    def to_labels(
        self,
        scores: Float[Tensor, "images classes height width"],
        shape: tuple[int, int],
        rotation: NDArray[np.float64] | None = None,
    ) -> Integer[Tensor, "rows columns"]:
        """Render the scores (not labels) back to the panorama, then take the best class."""
        if self.blend == "feather":
            scores = scores.softmax(dim=1)
        grid = self.grid.with_rotation(_unless_identity(rotation))
        labels: Tensor = tangent_to_labels(scores, grid, shape, self.blend)
        return labels


@registered
class TangentRepresentation(PinholeRepresentation):
    """Tangent images (paper, section 3.2).

    Args:
        base_level: Base level b: 20·4^b images.
        level: Level s; it sets the angular resolution of the images.
        dim: Side of the images in pixels, default 2^(s−b).
        crop_multiple: Instead of `dim`: crop to the owned cells, the side rounded up to a multiple
            of this (the network's stride).
        faces_per_panorama: Images drawn at random for a training sample; all by default.
        rotation: Rotation of the icosahedron while training.
        mirror: Mirror half of the training samples left to right.
        blend: How overlapping images are joined in evaluation: the scores of the owner
            (`nearest`), or probabilities averaged with weights that fall to the borders
            (`feather`).
        erp_height: Rows of the panorama, default `equirect_shape(level)`.
        average_rotations: Turns of the icosahedron that evaluation averages over, see `turns`.

    Raises:
        SettingError: An impossible combination.
    """

    grid: TangentGrid

    def __init__(
        self,
        base_level: int,
        level: int,
        dim: int | None = None,
        crop_multiple: int | None = None,
        faces_per_panorama: int | None = None,
        rotation: RotationAugmentation = "none",
        mirror: bool = False,
        blend: Blend = "nearest",
        erp_height: int | None = None,
        average_rotations: int = 1,
    ) -> None:
        if crop_multiple is not None:
            _at_least("crop_multiple", crop_multiple, 1)
            if dim is not None:
                raise SettingError(
                    "representation.dim", found=dim, expected="null beside crop_multiple"
                )
            least = TangentGrid.least_dim(base_level, level)
            dim = math.ceil(least / crop_multiple) * crop_multiple
        grid = TangentGrid(base_level, level, dim)
        count = grid.num_images
        if faces_per_panorama is not None and not 1 <= faces_per_panorama <= count:
            raise SettingError(
                "representation.faces_per_panorama",
                found=faces_per_panorama,
                expected=f"1 to {count} at base level {base_level}, or null for all",
            )
        super().__init__(grid, level, rotation, mirror, erp_height, blend, faces_per_panorama)
        self._turns = turns(average_rotations, "representation.average_rotations")

    def whole(self) -> Views:
        """All images, of every turn that is averaged over."""
        views = [PinholeViews(spun(self.grid, turn)) for turn in self._turns]
        return views[0] if len(views) == 1 else ManyViews(tuple(views))

    def to_averaged_labels(
        self, scores: Iterable[Tensor], shape: tuple[int, int], rotations: NDArray[np.float64]
    ) -> Integer[Tensor, "rows columns"]:
        """The class with the highest mean probability over several turns, as in prediction.

        Args:
            scores: Of all images of each turn, one turn after the other.
            shape: ``(H, W)`` of the panorama.
            rotations: Of the turns, see `Views.rotations`.

        Returns:
            Class indices, on the CPU.
        """
        mosaic: ScoreMosaic | None = None
        for of_turn, rotation in zip(scores, rotations, strict=True):
            mosaic = mosaic or ScoreMosaic(shape, of_turn.shape[1], self.blend, averaged=True)
            grid = self.grid.with_rotation(_unless_identity(rotation))
            mosaic.add(of_turn, grid, np.arange(grid.num_images))
        if mosaic is None:
            raise SettingError("rotations", found=0, expected="one or more")
        return torch.from_numpy(mosaic.labels().astype(np.int64))


@registered
class EquirectRepresentation:
    """The baseline without tangent images: the equirectangular image, or random crops of it.

    Evaluation always sees the whole image.

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
        self.erp_height = _erp_height(erp_height, level)
        self.crop_deg = crop_deg
        self.rotation = _checked_choice("rotation", rotation, ("none", "yaw", "so3"))
        self.mirror = mirror
        self._turn: NDArray[np.float64] | None = None

    def turned(self, rotation: NDArray[np.float64]) -> Self:
        """The same of panoramas looked at turned, R·d; instead of a turn before."""
        turned = copy.copy(self)
        turned._turn = _unless_identity(rotation)
        return turned

    @property
    def image_size(self) -> tuple[int, int]:
        """Rows and columns of the panorama, which evaluation sees."""
        return self.erp_height, 2 * self.erp_height

    def sample(self, rng: np.random.Generator) -> Views:
        """The panorama or one crop of it, (perhaps) turned."""
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
        self,
        scores: Float[Tensor, "images classes height width"],
        shape: tuple[int, int],
        rotation: NDArray[np.float64] | None = None,
    ) -> Integer[Tensor, "rows columns"]:
        """The best class of every pixel; the scores are already those of the (turned) panorama."""
        if scores.shape[0] != 1 or tuple(scores.shape[-2:]) != tuple(shape):
            raise SettingError(
                "scores of an equirectangular network",
                found=tuple(scores.shape),
                expected=f"one image of {shape[0]}×{shape[1]}",
            )
        labels = scores[0].argmax(dim=0)
        turn = _unless_identity(rotation)
        if turn is None:
            return labels
        small = labels.to(torch.int32).cpu().numpy().astype(np.uint16)
        back = rotate_equirect(small, turn, "nearest").astype(np.int64)
        return torch.from_numpy(back).to(labels.device)


def turns(count: int, setting: str) -> list[NDArray[np.float64]]:
    """Rotations of the icosahedron to average over, evenly about the vertical; none is the first.

    Images stay upright, as most networks know them: any rotation at all halves their scores.

    Args:
        count: How many, 1 or more.
        setting: Its name, for the message.

    Raises:
        SettingError: Fewer.
    """
    if not isinstance(count, int) or count < 1:
        raise SettingError(setting, found=count, expected="a whole number from 1")
    step = math.radians(_SYMMETRY_DEG / count)
    return [rotation_about((0, 0, 1), step * k) for k in range(count)]


def spun(grid: _Grid, turn: NDArray[np.float64]) -> _Grid:
    """A grid turned about its own axes: with a rotation R it has, directions become R·turn·d.

    Args:
        grid: The images.
        turn: ``(3, 3)`` rotation.
    """
    rotation = turn if grid.rotation is None else grid.rotation @ turn
    return grid.with_rotation(_unless_identity(rotation))


def _unless_identity(rotation: NDArray[np.float64] | None) -> NDArray[np.float64] | None:
    """None for no turn at all: the tables of grids that are not turned are those kept."""
    return None if rotation is None or np.array_equal(rotation, np.eye(3)) else rotation


def _erp_height(rows: int | None, level: int) -> int:
    return equirect_shape(level)[0] if rows is None else _at_least("erp_height", rows, 2)


def _at_least(name: str, value: int, least: int) -> int:
    if value < least:
        raise SettingError(f"representation.{name}", found=value, expected=f"{least} or more")
    return value


def _checked_choice(name: str, value: _Choice, allowed: tuple[str, ...]) -> _Choice:
    if value not in allowed:
        raise SettingError(
            f"representation.{name}", found=repr(value), expected=f"one of {', '.join(allowed)}"
        )
    return value
