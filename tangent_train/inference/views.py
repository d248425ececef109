"""Views of new panoramas and photos for a trained network."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from datamodules.core.panoramas import distance_from_z_depth, resize_area, resize_depth
from datamodules.core.samples import world_rays
from tangent_train.errors import SettingError, width_height
from tangent_train.registry import build_from_config
from tangent_train.rendering import EquirectRepresentation, PerspectiveRepresentation
from tangent_train.rendering.representations.equirect import EquirectViews, as_crop, column_shifts
from tangent_train.rendering.representations.perspective import PhotoCrops
from tangent_train.rendering.representations.pinhole import PinholeRepresentation, spun, turns
from tangent_train.rendering.representations.views import NO_RAYS, PinholeViews
from tangent_train.rendering.upright.gravity import upright_rotation

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray
    from torch import Tensor

    from tangent_train.checkpoints.trained import TrainedNetwork
    from tangent_train.geometry import PinholeGrid
    from tangent_train.rendering import Blend
    from tangent_train.rendering.mosaic import ScoreMosaic

_TANGENT = "tangent_train.rendering.TangentRepresentation"
_PERSPECTIVE = "tangent_train.rendering.PerspectiveRepresentation"

_BASE_LEVEL = 1
"""For networks trained on photos (paper, section 5: transfer uses b = 1)."""

_OVERLAP = 0.25
"""Least overlap of neighbouring crops of a photo that are feathered, as a share of their side."""

_OVERSAMPLED = 2
"""Photos are shrunk to so many pixels per pixel of a crop before they are mirrored."""


@dataclass(frozen=True)
class InputImage:
    """A panorama of the whole sphere, or a photo.

    Attributes:
        rgb: ``(H, W, 3)`` uint8.
        depth: ``(H, W)`` uint16 in steps of 1/512 m, 0 where missing: distance from the centre in
            panoramas, along the optical axis in photos; or None.
        up: ``(3,)`` direction of the zenith in a panorama; None where that is z.
        camera_matrix: ``(3, 3)`` K of a photo, integer pixel centres; None for panoramas.
    """

    rgb: NDArray[np.uint8]
    depth: NDArray[np.uint16] | None = None
    up: NDArray[np.float64] | None = None
    camera_matrix: NDArray[np.float64] | None = None


@dataclass(frozen=True)
class ViewSet:
    """Views that together show all of an image.

    Attributes:
        image: The image at the resolution it is rendered from.
        count: Number of views N.
        views: Gives some of the views.
        add: Adds the scores ``(n, K, h, w)`` of some of the views to those of the image.
        rays: ``(N, 3, 3)`` in a gravity-aligned frame, see `Views.rays`; ``(0, 3, 3)`` where the
            views are not of one sphere.
    """

    image: InputImage
    count: int
    views: Callable[[slice], Any]
    add: Callable[[ScoreMosaic, Tensor, slice], None]
    rays: NDArray[np.float32] = field(default_factory=lambda: NO_RAYS)


class PanoramaViews:
    """Views of panoramas, by default those of training; scores of several sets are averaged.

    Networks trained on photos get tangent images of base level 1, at the level that matches the
    angular resolution of their crops.

    Args:
        trained: The network.
        levels: Levels s to average over, the angular resolution; None as trained.
        base_level: Base level b of tangent images; None as trained.
        blend: Blending of overlapping views.
        rotations: Number of rotations about the vertical to average over: of the icosahedron or of
            equirectangular images.
        upright: Whether some panoramas will have their own `InputImage.up`.

    Raises:
        SettingError: The network cannot take such views.
    """

    def __init__(
        self,
        trained: TrainedNetwork,
        levels: Sequence[int | None] = (None,),
        base_level: int | None = None,
        blend: Blend = "feather",
        rotations: int = 1,
        *,
        upright: bool = False,
    ) -> None:
        self._seen = [panorama_representation(trained, level, base_level) for level in levels]
        self._rotations = rotations
        self._turns = turns(rotations, "rotations")
        self.image_size = max(seen.image_size for seen in self._seen)
        self.blend: Blend = blend
        if upright or len(levels) > 1:
            self.need_tangent_images(f"upright={upright} and {len(levels)} levels")
        for seen in self._seen:
            if isinstance(seen, EquirectRepresentation) or not seen.grid.overlapping:
                self.blend = "nearest"

    def need_tangent_images(self, given: str) -> None:
        """Refuse settings that equirectangular images do not have.

        Args:
            given: The settings, for the message.

        Raises:
            SettingError: The network takes such images.
        """
        if any(isinstance(seen, EquirectRepresentation) for seen in self._seen):
            raise SettingError(
                "upright and levels",
                found=given,
                expected="neither, for a network that takes equirectangular images",
                remedy="Give base_level= to use tangent images.",
            )

    def __call__(self, image: InputImage) -> list[ViewSet]:
        """One set for every level and rotation."""
        return [views for seen in self._seen for views in self._sets(image, seen)]

    def _sets(
        self, image: InputImage, seen: PinholeRepresentation | EquirectRepresentation
    ) -> list[ViewSet]:
        if isinstance(seen, EquirectRepresentation):
            whole = resized(image, seen.image_size)
            shifts = column_shifts(seen.image_size[1], self._rotations)
            return [_equirect_set(whole, shift, image.rgb.shape[:2]) for shift in shifts]
        grid = seen.grid
        if image.up is not None:
            grid = grid.with_rotation(upright_rotation(image.up))
        rows = seen.erp_height
        if image.rgb.shape[0] > rows:
            image = resized(image, (rows, 2 * rows))
        return [grid_set(image, spun(grid, turn)) for turn in self._turns]


class PhotoViews:
    """Crops of photos, with the size and angular resolution of the network's training images.

    Args:
        trained: The network.
        level: Level s, the angular resolution; None as trained.
        base_level: Crops of the size of tangent images of another base level b.
        blend: ``feather``: crops overlap by a quarter and are averaged.

    Raises:
        SettingError: The network cannot take such crops.
    """

    def __init__(
        self,
        trained: TrainedNetwork,
        level: int | None = None,
        base_level: int | None = None,
        blend: Blend = "feather",
    ) -> None:
        if "elevation" in trained.inputs:
            raise SettingError(
                "projection",
                found="perspective",
                expected="equirectangular: the network takes the elevation of every pixel, which "
                "is unknown in photos",
            )
        self._crops = _photo_representation(trained, level, base_level)
        self.image_size = self._crops.image_size
        self.blend: Blend = blend

    def __call__(self, image: InputImage) -> list[ViewSet]:
        """Crops that cover the photo; one smaller than a crop is mirrored at its borders."""
        padded, matrix, to_photo = _padded(image, self._crops)
        sampler = self._crops.of_camera(matrix, padded.rgb.shape[:2])
        crops = sampler.cover(_OVERLAP if self.blend == "feather" else 0.0)
        placed = replace(crops, boxes=to_photo(crops.boxes))

        numbers = np.arange(len(crops.boxes))

        def views(part: slice) -> PhotoCrops:
            return replace(crops, boxes=crops.boxes[part])

        def add(mosaic: ScoreMosaic, scores: Tensor, part: slice) -> None:
            mosaic.add_crops(scores, placed, numbers[part])

        return [ViewSet(padded, len(numbers), views, add)]


def panorama_settings(
    trained: TrainedNetwork, level: int | None = None, base_level: int | None = None
) -> dict[str, Any]:
    """The section of a config for the representation of panoramas, see `PanoramaViews`.

    Args:
        trained: The network.
        level: Level s; None as trained.
        base_level: Base level b of tangent images; None as trained.
    """
    settings: dict[str, Any] = dict(trained.representation)
    kind = settings["_target_"]
    if kind == _PERSPECTIVE or (base_level is not None and kind != _TANGENT):
        settings = {"_target_": _TANGENT, "base_level": _BASE_LEVEL}
    if settings["_target_"] == _TANGENT and base_level not in (None, settings["base_level"]):
        settings |= {"base_level": base_level, "dim": None, "faces_per_panorama": None}
    if level not in (None, trained.level):
        settings |= {"erp_height": None} | ({"dim": None} if "dim" in settings else {})
    settings["level"] = trained.level if level is None else level
    if settings["_target_"] == _TANGENT and trained.fixed_size is not None:
        side = max(trained.fixed_size)
        if base_level is None and settings.get("dim") is None:
            settings["base_level"] = max(0, math.ceil(settings["level"] - math.log2(side)))
        own = settings.get("dim") or 2 ** (settings["level"] - settings["base_level"])
        settings["dim"] = max(own, side)  # larger ones are divided
    return settings


def panorama_representation(
    trained: TrainedNetwork, level: int | None = None, base_level: int | None = None
) -> PinholeRepresentation | EquirectRepresentation:
    """The representation of panoramas of `panorama_settings`.

    Raises:
        SettingError: The network cannot take its images.
    """
    settings = panorama_settings(trained, level, base_level)
    made: Any = build_from_config(settings, "representation", trained.source)
    check_size(trained, made.image_size)
    return made


def _photo_representation(
    trained: TrainedNetwork, level: int | None, base_level: int | None
) -> PerspectiveRepresentation:
    wanted = trained.level if level is None else level
    settings = trained.representation
    if settings["_target_"] == _PERSPECTIVE and base_level is None:
        half_extent = math.tan(math.radians(settings.get("fov_deg", 45.0)) / 2)
        half_extent /= 2.0 ** (wanted - trained.level)
        size = trained.image_size
    else:
        seen = panorama_representation(trained, level, base_level)
        if isinstance(seen, EquirectRepresentation):
            return _photo_representation(trained, level, _BASE_LEVEL)
        size, half_extent = seen.image_size, seen.grid.dim / 2 * seen.grid.pitch
    check_size(trained, size)
    return PerspectiveRepresentation(wanted, 2 * math.degrees(math.atan(half_extent)), size)


def check_size(trained: TrainedNetwork, size: tuple[int, int]) -> None:
    """Refuse images that a network does not take.

    Args:
        trained: The network.
        size: Rows and columns of the images.

    Raises:
        SettingError: It does not take them.
    """
    fixed, multiple = trained.fixed_size, trained.size_multiple
    small = fixed is not None and any(n < own for n, own in zip(size, fixed, strict=True))
    if small or (fixed is None and any(side % multiple for side in size)):
        raise SettingError(
            "level and base_level",
            found=f"images of {width_height(size)}",
            expected=f"at least {width_height(fixed)}, as the network's file takes"
            if fixed
            else f"multiples of {multiple}, as the network needs",
            remedy="Choose other levels, or leave both as trained.",
        )


def grid_set(
    image: InputImage, grid: PinholeGrid, faces: NDArray[np.int64] | None = None
) -> ViewSet:
    """The images of a grid, or some of them, as views of a panorama."""
    faces = grid.face_indices(faces)

    def views(part: slice) -> PinholeViews:
        return PinholeViews(grid, faces[part])

    def add(mosaic: ScoreMosaic, scores: Tensor, part: slice) -> None:
        mosaic.add(scores, grid, faces[part])

    rays = world_rays(PinholeViews(grid, faces), image.up)
    return ViewSet(image, len(faces), views, add, rays)


def _equirect_set(image: InputImage, shift: int, shape: tuple[int, int]) -> ViewSet:
    """The panorama itself, rotated by some of its columns; `shape` is that of the result."""
    depth = None if image.depth is None else np.roll(image.depth, -shift, axis=1)
    turned = replace(image, rgb=np.roll(image.rgb, -shift, axis=1), depth=depth)

    def add(mosaic: ScoreMosaic, scores: Tensor, _: slice) -> None:
        mosaic.add_crops(*as_crop(scores.roll(shift, -1), shape), np.array([0]))

    return ViewSet(turned, 1, lambda _: EquirectViews(), add)


def resized(image: InputImage, shape: tuple[int, int]) -> InputImage:
    """An image of another size, as training resizes panoramas; depth is never averaged."""
    depth = None if image.depth is None else resize_depth(image.depth, shape)
    if image.rgb.shape[0] >= shape[0]:
        return replace(image, rgb=resize_area(image.rgb, shape), depth=depth)
    rgb = cv2.resize(image.rgb, shape[::-1], interpolation=cv2.INTER_LINEAR)
    return replace(image, rgb=rgb, depth=depth)


def _padded(
    image: InputImage, wanted: PerspectiveRepresentation
) -> tuple[InputImage, NDArray[np.float64], Callable[[NDArray[np.float64]], NDArray[np.float64]]]:
    """A photo mirrored at its borders as far as a crop is larger.

    Returns:
        The image with distance as depth; its K, with the principal point in a corner; and what maps
        boxes in it to boxes in the photo.
    """
    matrix, size = np.array(image.camera_matrix), image.rgb.shape[:2]
    depth = None if image.depth is None else distance_from_z_depth(image.depth, matrix)
    pixel = 2 * math.tan(math.radians(wanted.fov_deg) / 2) / wanted.image_size[1]
    per_pixel = pixel * np.diag(matrix)[[1, 0]]  # photo pixels per crop pixel, down and across
    # Shrunk first: mirrored at full resolution, a photo of a telescope would fill the memory.
    kept = np.minimum(1, _OVERSAMPLED / per_pixel)
    rows, columns = (max(1, round(n * share)) for n, share in zip(size, kept, strict=True))
    scale = np.array([columns / size[1], rows / size[0]])
    least = np.ceil(wanted.image_size * per_pixel * scale[::-1] + 1e-6)
    top, left = (math.ceil(max(0, a - b) / 2) for a, b in zip(least, (rows, columns), strict=True))
    borders = (top, top, left, left, cv2.BORDER_REFLECT_101)
    rgb = cv2.copyMakeBorder(resize_area(image.rgb, (rows, columns)), *borders)
    if depth is not None:
        depth = cv2.copyMakeBorder(resize_depth(depth, (rows, columns)), *borders)
    # Crops that cover the whole image do not depend on its principal point.
    focal = np.diag([*np.diag(matrix)[:2] * scale, 1])
    offset, factor = np.tile((left, top), 2), np.tile(scale, 2)
    return InputImage(rgb, depth), focal, lambda boxes: (boxes - offset) / factor
