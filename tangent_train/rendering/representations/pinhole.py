"""Pinhole images around the center: tangent images, horizontal views in rings, cube maps."""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping, Sequence
from typing import Any, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from tangent_train.errors import SettingError, at_least, check_choice
from tangent_train.geometry import (
    CubeGrid,
    PinholeGrid,
    RingGrid,
    TangentGrid,
    equirect_shape,
    panorama_rows,
    random_rotation,
    rotation_about,
)
from tangent_train.geometry.camera import half_width
from tangent_train.geometry.coverage import best_views, check_coverage, needed_views
from tangent_train.geometry.sphere import area_mask, check_area, lonlat_to_xyz
from tangent_train.kinds import MOST_ROTATIONS
from tangent_train.rendering.forward import Blend, blend_of
from tangent_train.rendering.representations.views import STRIDE, PinholeViews, RotationAugmentation

_Grid = TypeVar("_Grid", bound=PinholeGrid)

_ROWS = 360
"""Rows of the mask of the area that the views must cover."""


class PinholeRepresentation:
    """Pinhole images around the center: base of tangent images, horizontal views and cube maps.

    Args:
        grid: Images of `level`, not rotated.
        grids: Images of each level to average over, not rotated.
        level: Level s of the panorama.
        random_rotation: Rotation of the images as a whole in training.
        mirror: True to mirror half of the training samples left to right.
        erp_height: Rows of the panorama, default `equirect_shape(level)`.
        blend: Blending of overlapping images.
        rotations: Number of rotations about the vertical to average over.
        faces_per_panorama: Number of random images in a training sample; all by default.
        is_partial: True if the images do not cover the sphere.
        is_joint: True if only all grids together cover what the representation covers.

    Attributes:
        grid: Images of `level`, not rotated.
        grids: Images of each level to average over, not rotated.

    Raises:
        SettingError: A setting is invalid.
    """

    symmetry_deg: float
    """Rotation about the vertical after which the images cover the same directions again."""

    def __init__(
        self,
        grid: PinholeGrid,
        grids: Sequence[PinholeGrid],
        level: int,
        random_rotation: RotationAugmentation,
        mirror: bool,
        erp_height: int | None,
        blend: Blend,
        rotations: int,
        faces_per_panorama: int | None = None,
        is_partial: bool = False,
        is_joint: bool = False,
    ) -> None:
        choices = ("none", "yaw", "so3")
        check_choice("representation.random_rotation", random_rotation, choices)
        check_choice("representation.blend", blend, ("nearest", "feather"))
        count = grid.num_images
        if faces_per_panorama is not None and not 1 <= faces_per_panorama <= count:
            raise SettingError(
                "representation.faces_per_panorama",
                found=faces_per_panorama,
                expected=f"1 to {count}, or null for all views",
            )
        self.grid: PinholeGrid = grid
        self.random_rotation = random_rotation
        self.mirror = mirror
        self.erp_height = panorama_rows(level, erp_height)
        self.blend = blend
        self.faces_per_panorama = faces_per_panorama
        self.grids = grids
        self._rotations = vertical_rotations(rotations, self.symmetry_deg)
        self._is_partial, self._is_joint = is_partial, is_joint

    @property
    def image_size(self) -> tuple[int, int]:
        """Rows and columns of the images."""
        return self.grid.size

    def with_rotation(self, rotation: NDArray[np.float64]) -> Self:
        """Return the same representation in rotated directions R·d."""
        rotated = copy.copy(self)
        rotation_or_none = unless_identity(rotation)
        rotated.grid = self.grid.with_rotation(rotation_or_none)
        rotated.grids = [grid.with_rotation(rotation_or_none) for grid in self.grids]
        return rotated

    def sample(
        self, rng: np.random.Generator, valid: NDArray[np.bool_] | None = None
    ) -> PinholeViews:
        """Return all images or a random subset, optionally rotated as a whole and each mirrored.

        Of a partial panorama, they are as many as its valid pixels need without rotation, so that
        samples of one batch have equal numbers: those of `needed_views`, or under rotation those
        that see most valid pixels. Joint grids: images of one, drawn by their number.
        """
        grids = self.grids if self._is_joint else [self.grid]
        needed = self._needed([grid.with_rotation(None) for grid in grids], valid)
        counts = np.array([len(faces) for faces in needed])
        drawn = rng.choice(len(grids), p=counts / counts.sum()) if self._is_joint else 0
        grid, faces = grids[drawn], needed[drawn]
        if self.random_rotation != "none":
            is_yaw = self.random_rotation == "yaw"
            angle = rng.uniform(0, 2 * math.pi)
            rotation = rotation_about((0, 0, 1), angle) if is_yaw else random_rotation(rng)
            grid = _rotated(grid, rotation)
        if valid is not None and grid.rotation is not None:
            faces = best_views(grid, valid, len(faces))
        is_subset = self.faces_per_panorama is not None or self._is_joint
        if is_subset:
            most = counts[counts > 0].min()
            faces = rng.choice(faces, min(self.faces_per_panorama or most, most), replace=False)
        mirrored = self.mirror and bool(rng.random() < 0.5)
        return PinholeViews(grid, None if valid is None and not is_subset else faces, mirrored)

    def _needed(
        self, grids: Sequence[PinholeGrid], valid: NDArray[np.bool_] | None
    ) -> list[NDArray[np.int64]]:
        """Return the images of grids under one rotation that the valid pixels need.

        Args:
            grids: Grids to average over, or grids of a joint representation.
            valid: See `sample`.
        """
        if valid is None:
            return [grid.face_indices() for grid in grids]
        if self._is_joint:
            return needed_views(grids, valid)
        blends = (blend_of(self.blend, is_overlapping=grid.is_overlapping) for grid in grids)
        return [
            needed_views([grid], valid, by_owners=blend == "nearest")[0]
            for grid, blend in zip(grids, blends, strict=True)
        ]

    def view_sets(self, valid: NDArray[np.bool_] | None = None) -> list[PinholeViews]:
        """Return the images of every level in every rotation: all, or those of `needed_views`.

        Raises:
            SettingError: The images of a partial representation do not cover the valid pixels.
        """
        rotated = [[_rotated(grid, r) for grid in self.grids] for r in self._rotations]
        for grids in rotated if self._is_partial else ():
            check_coverage(grids, valid)
        of_rotations = (zip(grids, self._needed(grids, valid), strict=True) for grids in rotated)
        pairs = [pair for of_grid in zip(*of_rotations, strict=True) for pair in of_grid]
        if valid is not None:
            pairs = [(grid.subset(faces), faces) for grid, faces in pairs if len(faces)]
        return [PinholeViews(grid) for grid, _ in pairs]


class TangentRepresentation(PinholeRepresentation):
    """Tangent images (paper, section 3.2).

    Args:
        base_level: Base level b: 20·4^b images.
        level: Level s, which sets the angular resolution of the images.
        dim: Side of the images in pixels, default 2^(s−b).
        crop_multiple: Crop to the owned cells, with the side rounded up to a multiple of this
            number (the network's stride). Replaces `dim`.
        faces_per_panorama: Number of random images in a training sample; all by default.
        random_rotation: Rotation of the icosahedron in training.
        mirror: True to mirror half of the training samples left to right.
        blend: Blending of overlapping images in evaluation and prediction: the scores of the owner
            (`nearest`), or the average of probabilities with weights that fall to 0 at the borders
            (`feather`).
        erp_height: Rows of the panorama, default `equirect_shape(level)`.
        rotations: Number of rotations of the icosahedron to average over, see `vertical_rotations`.
        levels: One or more levels to average over, default `level`. All have images of the same
            number of pixels, so images of a lower level have a wider field of view.

    Raises:
        SettingError: Settings are invalid or exclude each other.
    """

    grid: TangentGrid
    symmetry_deg = 72.0

    def __init__(
        self,
        base_level: int,
        level: int,
        dim: int | None = None,
        crop_multiple: int | None = None,
        faces_per_panorama: int | None = None,
        random_rotation: RotationAugmentation = "none",
        mirror: bool = False,
        blend: Blend = "feather",
        erp_height: int | None = None,
        rotations: int = 1,
        levels: int | Sequence[int] | None = None,
    ) -> None:
        if crop_multiple is not None:
            if dim is not None:
                raise SettingError(
                    "representation.dim", found=dim, expected="null beside crop_multiple"
                )
            least = TangentGrid.least_dim(base_level, level)
            dim = math.ceil(least / crop_multiple) * crop_multiple
        grid = TangentGrid(base_level, level, dim)
        super().__init__(
            grid,
            [TangentGrid(base_level, other, grid.dim) for other in level_list(levels, level)],
            level,
            random_rotation,
            mirror,
            erp_height,
            blend,
            rotations,
            faces_per_panorama,
        )


class HorizontalRepresentation(PinholeRepresentation):
    """Horizontal views in rings, with a level horizon as in photos.

    Args:
        level: Level s, which sets the angular resolution of the views.
        rings: Rings of views: ``pitch`` (latitude of the centers in degrees), number of ``views``
            around the vertical, and optionally their own ``fov``. Views of all rings have the same
            number of pixels. None for `covering_rings`.
        fov: Horizontal and vertical field of view in degrees, or one number for both.
        dim: Rows and columns in pixels, or only the columns; see `ring_size` for the default.
        square_pixels: True for square pixels: rows and columns of another ratio than `fov` show
            more than it. False to stretch exactly `fov` to them, like photos that were squashed.
        overlap: Overlap of neighbors in `covering_rings`.
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
    must_cover = True

    def __init__(
        self,
        level: int,
        rings: Sequence[Mapping[str, float | Sequence[float]]] | None,
        fov: float | Sequence[float],
        dim: int | Sequence[int] | None = None,
        faces_per_panorama: int | None = None,
        random_rotation: RotationAugmentation = "none",
        mirror: bool = False,
        blend: Blend = "feather",
        erp_height: int | None = None,
        rotations: int = 1,
        area: Sequence[float] | None = None,
        square_pixels: bool = True,
        overlap: float = 0.25,
    ) -> None:
        if rings is None:
            rings = covering_rings(_pair(fov), overlap)
        by_fov: dict[tuple[float, float], list[dict[str, Any]]] = {}
        for ring in rings:
            others = {name: value for name, value in ring.items() if name != "fov"}
            by_fov.setdefault(_pair(ring.get("fov", fov)), []).append(others)
        if not by_fov:
            raise SettingError("representation.rings", found="[]", expected="one ring or more")
        is_joint = len(by_fov) > 1
        if is_joint and blend == "nearest" and self.must_cover:
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
        is_complete = self.must_cover and not is_joint
        kinds = {"by_owners": blend == "nearest", "is_complete": is_complete}
        kinds["square_pixels"] = square_pixels
        grids = [RingGrid(part, of, size, None, covered, **kinds) for of, part in by_fov.items()]
        if is_joint and self.must_cover:
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


class SeparateViews(HorizontalRepresentation):
    """Horizontal views for other programs, which need not cover the sphere."""

    must_cover = False


class CubemapRepresentation(PinholeRepresentation):
    """Cube-map baseline: the six faces of a cube, all used in training and evaluation.

    Args:
        level: Level s of the panorama.
        dim: Side of the faces in pixels, default 2^s plus twice the margin. With it, 90° have as
            many pixels as on the panorama's equator.
        margin: Pixels of a face beyond its 90° on every side, which show its surroundings.
        blend: Blending of faces with a margin, see `TangentRepresentation`.
        random_rotation: Rotation of the cube in training.
        mirror: True to mirror each face of half of the training samples left to right.
        erp_height: Rows of the panorama, default `equirect_shape(level)`.
        rotations: Number of rotations of the cube to average over, see `vertical_rotations`.

    Raises:
        SettingError: A setting is invalid.
    """

    grid: CubeGrid
    symmetry_deg = 90.0

    def __init__(
        self,
        level: int,
        dim: int | None = None,
        random_rotation: RotationAugmentation = "none",
        mirror: bool = False,
        erp_height: int | None = None,
        margin: int = 0,
        blend: Blend = "feather",
        rotations: int = 1,
    ) -> None:
        quarter = equirect_shape(level)[1] // 4
        grid = CubeGrid(quarter + 2 * margin if dim is None else dim, margin=margin)
        super().__init__(grid, [grid], level, random_rotation, mirror, erp_height, blend, rotations)


def level_list(levels: int | Sequence[int] | None, level: int) -> list[int]:
    """Return a setting for one or more levels as a list; `[level]` if the setting is None.

    Raises:
        SettingError: The list is empty.
    """
    if levels is None:
        return [level]
    found = [levels] if isinstance(levels, int) else list(levels)
    if not found:
        raise SettingError("levels", found="[]", expected="a level, or several: [9, 10]")
    return found


def vertical_rotations(count: int, period_deg: float = 360.0) -> list[NDArray[np.float64]]:
    """Return evenly spaced rotations about the vertical to average over, the identity first.

    Images remain upright, as in the training of most networks: arbitrary rotations halve scores.

    Args:
        count: Number of rotations, 1 or more.
        period_deg: Angle after which images cover the same directions again.

    Raises:
        SettingError: The count is less than 1.
    """
    step = math.radians(period_deg / at_least("rotations", count, 1, MOST_ROTATIONS))
    return [rotation_about((0, 0, 1), step * k) for k in range(count)]


def unless_identity(rotation: NDArray[np.float64] | None) -> NDArray[np.float64] | None:
    """Return the rotation, or None for the identity, so that tables of the grid are cached."""
    return None if rotation is None or np.array_equal(rotation, np.eye(3)) else rotation


def _rotated(grid: _Grid, rotation: NDArray[np.float64]) -> _Grid:
    """Rotate a grid in its own axes: with its rotation R, directions become R·rotation·d."""
    outer = np.eye(3) if grid.rotation is None else grid.rotation
    return grid.with_rotation(unless_identity(outer @ rotation))


def covering_rings(fov_deg: tuple[float, float], overlap: float) -> list[dict[str, float]]:
    """Return rings of views of one field of view that cover the sphere.

    Args:
        fov_deg: Horizontal and vertical field of view in degrees.
        overlap: Least overlap of neighbors as a share of a view, from 0 to less than 1.

    >>> covering_rings((62, 48), 0.1)[:2]
    [{'pitch': 0.0, 'views': 8}, {'pitch': 43.2, 'views': 8}]
    """
    step = fov_deg[1] * (1 - overlap)
    rings: list[dict[str, float]] = []
    for number in range(1 + math.ceil((90 - fov_deg[1] / 2) / step)):
        pitch = min(number * step, 90.0)
        # The longitudes that a view at longitude 0 sees in the middle of its ring and at its lower
        # edge, where they are fewest.
        latitudes = (pitch + np.linspace(-0.5, 0.5, 9) * step).clip(max=90)
        angles = np.meshgrid(np.arange(0, 180, 0.5), latitudes)
        kinds: Any = {"square_pixels": False, "is_complete": False}
        view = RingGrid([{"pitch": pitch, "views": 1}], fov_deg, (2, 2), **kinds)
        seen = view.insets(lonlat_to_xyz(np.radians(np.stack(angles, -1)).reshape(-1, 2)))
        half = 0.5 * (seen.reshape(9, -1) >= 0).sum(axis=1).min()
        rings += [
            {"pitch": sign * pitch, "views": max(1, math.ceil(180 / (half * (1 - overlap))))}
            for sign in ((1, -1) if number else (1,))
        ]
    return rings


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
