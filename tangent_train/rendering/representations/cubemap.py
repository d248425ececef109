"""The cube map as a representation: the same networks on six images of 90°."""

from __future__ import annotations

from tangent_train.geometry import CubeGrid, equirect_shape
from tangent_train.registry import registered
from tangent_train.rendering.representations.pinhole import (
    PinholeRepresentation,
    RotationAugmentation,
)

__all__ = ["CubemapRepresentation"]


@registered
class CubemapRepresentation(PinholeRepresentation):
    """The baseline between panorama and tangent images: the six faces of a cube.

    Training and evaluation see all six. They do not overlap, so every pixel of the panorama takes
    the scores of the one face that sees it.

    Args:
        level: Level s of the panorama.
        dim: Side of the faces in pixels, default 2^s: 90° over as many pixels as on the
            panorama's equator.
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
    ) -> None:
        quarter = equirect_shape(level)[1] // 4
        grid = CubeGrid(quarter if dim is None else dim)
        super().__init__(grid, level, rotation, mirror, erp_height)
