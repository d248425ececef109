"""Horizontal views in rings as a representation."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from tangent_train.errors import SettingError, at_least
from tangent_train.geometry import PinholeGrid, RingGrid, TangentGrid
from tangent_train.geometry.camera import half_width
from tangent_train.geometry.coverage import check_coverage
from tangent_train.geometry.sphere import area_mask, check_area
from tangent_train.rendering.checks import Blend
from tangent_train.rendering.representations.pinhole import PinholeRepresentation
from tangent_train.rendering.representations.views import (
    STRIDE,
    RotationAugmentation,
)

_ROWS = 360
"""Rows of the mask of the area that the views must cover."""


class HorizontalRepresentation(PinholeRepresentation):
    """Horizontal views in rings, with a level horizon as in photos.

    Args:
        level: Level s, which sets the angular resolution of the views.
        rings: Rings of views: ``pitch`` (latitude of the centers in degrees), number of ``views``
            around the vertical, and optionally their own ``fov``. Views of all rings have the same
            number of pixels.
        fov: Horizontal and vertical field of view in degrees, or one number for both.
        dim: Rows and columns in pixels, or only the columns; see `ring_size` for the default.
            Pixels are square: rows and columns of another ratio than `fov` show more than it.
        faces_per_panorama: Number of random views in a training sample; all by default. A sample
            has views of one field of view, drawn in proportion to their number.
        random_rotation: Rotation of the views as a whole in training.
        mirror: True to mirror half of the training samples left to right.
        blend: Blending of overlapping views, see `TangentRepresentation`.
        erp_height: Rows of the panorama, default `equirect_shape(level)`.
        rotations: Number of rotations about the vertical to average over. They divide the step
            between neighbors of the ring with most views: 2 rotations are half a step apart.
        area: West, east, south and north in degrees of the area that the views must cover; the
            sphere by default.

    Raises:
        SettingError: A setting is invalid, or the views miss a direction.
    """

    grid: PinholeGrid

    def __init__(
        self,
        level: int,
        rings: Sequence[Mapping[str, float | Sequence[float]]],
        fov: float | Sequence[float],
        dim: int | Sequence[int] | None = None,
        faces_per_panorama: int | None = None,
        random_rotation: RotationAugmentation = "none",
        mirror: bool = False,
        blend: Blend = "feather",
        erp_height: int | None = None,
        rotations: int = 1,
        area: Sequence[float] | None = None,
    ) -> None:
        by_fov: dict[tuple[float, float], list[dict[str, Any]]] = {}
        for ring in rings:
            others = {name: value for name, value in ring.items() if name != "fov"}
            by_fov.setdefault(_pair(ring.get("fov", fov)), []).append(others)
        if not by_fov:
            raise SettingError("representation.rings", found="[]", expected="one ring or more")
        if len(by_fov) > 1 and blend == "nearest":
            raise SettingError(
                "representation.blend",
                found="nearest, with rings of different fov",
                expected="feather, or the same fov for all rings",
                remedy="Views such as horizontal or tangent have the same.",
            )
        size = ring_size(level, _pair(fov), dim)
        covered = None
        if area is not None:
            covered = area_mask(check_area(area, "representation.area"), (_ROWS, 2 * _ROWS))
        is_joint = len(by_fov) > 1
        coverage = {"by_owners": blend == "nearest", "is_complete": not is_joint}
        grids = [RingGrid(part, of, size, None, covered, **coverage) for of, part in by_fov.items()]
        if is_joint:
            check_coverage(grids, covered)
        self.symmetry_deg = 360 / max(ring["views"] for part in by_fov.values() for ring in part)
        super().__init__(
            min(grids, key=lambda grid: grid.num_images),
            grids,
            level,
            random_rotation,
            mirror,
            erp_height,
            blend,
            rotations,
            faces_per_panorama,
            covered is not None,
            is_joint,
        )


def _pair(fov: float | Sequence[float]) -> tuple[float, float]:
    pair: Any = (fov, fov) if isinstance(fov, int | float) else tuple(fov)
    return pair


def ring_size(
    level: int, fov_deg: tuple[float, float], dim: int | Sequence[int] | None = None
) -> tuple[int, int]:
    """Return rows and columns of horizontal views.

    By default, the middle of a view has about as many pixels per degree as the tangent images of
    base level 0: the columns are rounded to a multiple of 2^(s−2). The rows follow from the field
    of view, rounded up to a multiple of the largest power of two, up to 32, that divides the
    columns.

    Args:
        level: Level s of the panorama.
        fov_deg: Horizontal and vertical field of view in degrees.
        dim: Rows and columns, or only the columns; None for the default.

    Raises:
        SettingError: A setting is invalid.

    >>> ring_size(9, (100, 100)), ring_size(9, (100, 70)), ring_size(9, (60, 60), 640)
    ((512, 512), (320, 512), (640, 640))
    """
    across, down = map(half_width, fov_deg)
    if isinstance(dim, Sequence):
        if len(dim) != 2:
            raise SettingError("dim", found=list(dim), expected="columns, or [rows, columns]")
        return dim[0], dim[1]
    if dim is None:
        step = 2 ** max(0, level - 2)
        dim = max(1, round(2 * across / TangentGrid(0, level).pitch / step)) * step
    columns = at_least("dim", dim, 2)
    multiple = math.gcd(columns, STRIDE)
    return math.ceil(columns * down / across / multiple - 1e-9) * multiple, columns
