"""Pinhole images around the centre as representations: tangent images and cube maps."""

from __future__ import annotations

import copy
import math
from collections.abc import Iterable, Sequence
from itertools import chain
from typing import Self, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tangent_train.errors import SettingError
from tangent_train.geometry import (
    CubeGrid,
    PinholeGrid,
    TangentGrid,
    equirect_shape,
    random_rotation,
    rotation_about,
)
from tangent_train.registry import registered
from tangent_train.rendering.backward import Blend, tangent_to_labels
from tangent_train.rendering.checks import check_blend, check_choice, check_count
from tangent_train.rendering.mosaic import ScoreMosaic
from tangent_train.rendering.representations.views import (
    ManyViews,
    PinholeViews,
    RotationAugmentation,
    Views,
)

_SYMMETRY_DEG = 72.0
"""The icosahedron looks the same after this rotation about the vertical."""

_Grid = TypeVar("_Grid", bound=PinholeGrid)


class PinholeRepresentation:
    """Pinhole images around the centre: base of tangent images and cube maps.

    Args:
        grid: The images, not rotated.
        level: Level s of the panorama.
        rotation: Rotation of the images as a whole while training.
        mirror: Mirror half of the training samples left to right.
        erp_height: Rows of the panorama, default `equirect_shape(level)`.
        blend: Blending of overlapping images in evaluation.
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
        check_choice("representation.rotation", rotation, ("none", "yaw", "so3"))
        check_blend(blend, grid)
        self.rotation = rotation
        self.mirror = mirror
        self.erp_height = equirect_shape(level)[0] if erp_height is None else erp_height
        self.blend = blend
        self.faces_per_panorama = faces_per_panorama

    @property
    def image_size(self) -> tuple[int, int]:
        """Rows and columns of the images."""
        return self.grid.dim, self.grid.dim

    def turned(self, rotation: NDArray[np.float64]) -> Self:
        """The same with all images rotated, directions R·d, instead of a rotation before."""
        turned = copy.copy(self)
        turned.grid = self.grid.with_rotation(unless_identity(rotation))
        return turned

    def sample(self, rng: np.random.Generator) -> Views:
        """All images or a random subset, optionally rotated as a whole and mirrored one by one."""
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
        self, scores: Tensor, shape: tuple[int, int], rotation: NDArray[np.float64] | None = None
    ) -> Tensor:
        """Render the scores (not labels) back to the panorama, then take the best class."""
        if self.blend == "feather":
            scores = scores.softmax(dim=1)
        grid = self.grid.with_rotation(unless_identity(rotation))
        return tangent_to_labels(scores, grid, shape, self.blend)


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
        blend: Blending of overlapping images in evaluation: the scores of the owner
            (`nearest`), or probabilities averaged with weights that fall to the borders
            (`feather`).
        erp_height: Rows of the panorama, default `equirect_shape(level)`.
        average_rotations: Rotations of the icosahedron that evaluation averages over, see `turns`.
        further_levels: Levels that evaluation averages over besides `level`, with images of as many
            pixels: those of a lower level show more.

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
        further_levels: Sequence[int] = (),
    ) -> None:
        if crop_multiple is not None:
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
        further = [TangentGrid(base_level, other, grid.dim) for other in further_levels]
        self._grids = [grid, *further]

    def whole(self) -> Views:
        """All images, of every level and rotation that is averaged over."""
        grids = [grid.with_rotation(self.grid.rotation) for grid in self._grids]
        views = [PinholeViews(spun(grid, turn)) for grid in grids for turn in self._turns]
        return views[0] if len(views) == 1 else ManyViews(tuple(views))

    def to_averaged_labels(
        self, scores: Iterable[Tensor], shape: tuple[int, int], rotations: NDArray[np.float64]
    ) -> Tensor:
        """The class with the highest mean probability of all of `whole`, as in prediction.

        Args:
            scores: Of all images of `whole`, those of one level and rotation after the other.
            shape: ``(H, W)`` of the panorama.
            rotations: Of each of them, see `Views.rotations`.

        Returns:
            Class indices, on the CPU.
        """
        parts = iter(scores)
        first = next(parts)
        mosaic = ScoreMosaic(shape, first.shape[1], self.blend, averaged=True)
        grids = [grid for grid in self._grids for _ in self._turns]
        for one, grid, rotation in zip(chain([first], parts), grids, rotations, strict=True):
            turned = grid.with_rotation(unless_identity(rotation))
            mosaic.add(one, turned, np.arange(grid.num_images))
        return torch.from_numpy(mosaic.labels().astype(np.int64))


@registered
class CubemapRepresentation(PinholeRepresentation):
    """Cube-map baseline: the six faces of a cube.

    Training and evaluation use all six. Without a margin they do not overlap, and every pixel of
    the panorama takes the scores of a single face.

    Args:
        level: Level s of the panorama.
        dim: Side of the faces in pixels, default 2^s: 90° over as many pixels as on the
            panorama's equator.
        margin: Pixels of a face beyond its 90° on every side, which show its surroundings.
        blend: Blending of faces with a margin, see `TangentRepresentation`.
        rotation: Rotation of the cube while training.
        mirror: Mirror half of the training samples left to right, every face by itself.
        erp_height: Rows of the panorama, default `equirect_shape(level)`.

    Raises:
        SettingError: A value is impossible.
    """

    grid: CubeGrid

    def __init__(
        self,
        level: int,
        dim: int | None = None,
        rotation: RotationAugmentation = "none",
        mirror: bool = False,
        erp_height: int | None = None,
        margin: int = 0,
        blend: Blend = "nearest",
    ) -> None:
        quarter = equirect_shape(level)[1] // 4
        grid = CubeGrid(quarter + 2 * margin if dim is None else dim, margin=margin)
        super().__init__(grid, level, rotation, mirror, erp_height, blend)


def turns(count: int, setting: str) -> list[NDArray[np.float64]]:
    """Rotations of the icosahedron to average over, evenly about the vertical; none is the first.

    Images stay upright, as in most networks' training: arbitrary rotations halve their scores.

    Args:
        count: Number of rotations, 1 or more.
        setting: Its name, for the message.

    Raises:
        SettingError: Fewer.
    """
    check_count(setting, count)
    step = math.radians(_SYMMETRY_DEG / count)
    return [rotation_about((0, 0, 1), step * k) for k in range(count)]


def spun(grid: _Grid, turn: NDArray[np.float64]) -> _Grid:
    """A grid rotated about its own axes: with its rotation R, directions become R·turn·d.

    Args:
        grid: The images.
        turn: ``(3, 3)`` rotation.
    """
    rotation = turn if grid.rotation is None else grid.rotation @ turn
    return grid.with_rotation(unless_identity(rotation))


def unless_identity(rotation: NDArray[np.float64] | None) -> NDArray[np.float64] | None:
    """None for the identity: only tables of grids without a rotation are kept."""
    return None if rotation is None or np.array_equal(rotation, np.eye(3)) else rotation
