"""Select views of new panoramas and photos for a trained network."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple

import cv2
import numpy as np
from omegaconf import OmegaConf

from datamodules.core.depth import distance_from_z_depth, resize_depth
from tangent_train.config.build import build_from_config
from tangent_train.errors import SettingError, check_choice, counted, width_height
from tangent_train.files import config_folder
from tangent_train.geometry import TangentGrid
from tangent_train.inference.images import InputImage
from tangent_train.io.gpano import PanoramaArea
from tangent_train.orientation.gravity import upright_rotation
from tangent_train.rendering import PerspectiveRepresentation
from tangent_train.rendering.representations.pinhole import PinholeRepresentation, level_list
from tangent_train.rendering.representations.views import PinholeViews
from tangent_train.rendering.resampling import resize

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tangent_train.checkpoints.loaded import LoadedNetwork
    from tangent_train.io.gpano import Fill
    from tangent_train.rendering import Blend
    from tangent_train.rendering.representations.views import Views

Levels = int | Sequence[int] | None
"""A level s, which sets the angular resolution, or several to average over; None as trained."""

ViewChoice = str | Mapping[str, Any] | None
"""Views of panoramas: an option of the configs of representations, such as ``horizontal``; or its
name as ``option``, with changed settings of the representation. None as trained."""

_TANGENT = "tangent_train.rendering.TangentRepresentation"
PERSPECTIVE = "tangent_train.rendering.PerspectiveRepresentation"
HORIZONTAL = "tangent_train.rendering.HorizontalRepresentation"
_EQUIRECT = "tangent_train.rendering.EquirectRepresentation"
_ICOSPHERE = "tangent_train.rendering.IcosphereRepresentation"

_NOT_VIEWS = "icosphere", "perspective"
"""Options of the configs of representations that are not views for networks of photos."""

_VIEWS = "horizontal_wide"
"""Views of panoramas for imported photo networks, see docs/results/real_panoramas.md."""

_CAMERA = "horizontal_camera"
"""Views of panoramas like the photos of a network's training."""

_BASE_LEVEL = 1
"""For networks trained on photos (paper, section 5: transfer uses b = 1)."""

_OVERLAP = 0.25
"""Minimum overlap of neighboring crops of a photo with feathering, as a share of their side."""

_OVERSAMPLED = 2
"""Photos are resized to at most 2 pixels per pixel of a crop before their borders are mirrored."""


_MASK_ROWS = 360
"""Rows of the mask of the area that panoramas show."""


class SourceViews(NamedTuple):
    """Sets of views that are rendered from one image.

    Attributes:
        image: The panorama or photo.
        shape: Rows and columns to which it is resized first.
        sets: Sets of views, each of which covers the whole image, or the area of a panorama.
        rotation: ``(3, 3)`` rotation that aligns views of a panorama with gravity, or None.
    """

    image: InputImage
    shape: tuple[int, int]
    sets: Sequence[Views]
    rotation: NDArray[np.float64] | None = None


class ViewSelector:
    """Selects the views of panoramas and photos, by default as in training.

    Scores of several sets of views are averaged. Networks trained on photos get tangent images of
    base level 1 of panoramas, at the level that matches the angular resolution of their crops.
    Photos are divided into crops with the size and angular resolution of the training images.

    Args:
        loaded: The network.
        levels: See `Levels`. All are rendered from an image of the highest level.
        base_level: Base level b of tangent images, whose size crops of photos get too; None as
            trained.
        blend: Blending of overlapping views. With ``feather``, crops of photos overlap by at least
            a quarter.
        rotations: Number of rotations about the vertical to average over; not used for photos.
        views: Views of panoramas, see `ViewChoice`.
        fill: Colors outside the area of a partial panorama, in views that leave it; None as
            trained.
    """

    def __init__(
        self,
        loaded: LoadedNetwork,
        levels: Levels = None,
        base_level: int | None = None,
        blend: Blend = "feather",
        rotations: int = 1,
        views: ViewChoice = None,
        fill: Fill | None = None,
    ) -> None:
        self._loaded, self._levels, self._base_level = loaded, levels, base_level
        self._blend, self._rotations, self._views = blend, rotations, views
        self._fill = fill or loaded.fill

    @cached_property
    def representation(self) -> Any:
        """Representation of upright panoramas.

        Raises:
            SettingError: The network does not support such views.
        """
        given = self._loaded, self._levels, self._base_level, self._views
        settings = panorama_settings(*given) | {"rotations": self._rotations}
        if settings["_target_"] not in (_EQUIRECT, _ICOSPHERE):
            settings["blend"] = self._blend
        return _built(self._loaded, settings)

    @cached_property
    def crops(self) -> list[PerspectiveRepresentation]:
        """Common camera of the crops of photos for each level.

        Raises:
            SettingError: The network does not support such crops.
        """
        loaded = self._loaded
        if "elevation" in loaded.inputs:
            expected = "a panorama: the elevation of pixels, which the network takes, is unknown"
            raise SettingError("image", found="a photo", expected=expected)
        levels = level_list(self._levels, loaded.photo_level or loaded.level)
        return [_photo_representation(loaded, level, self._base_level) for level in levels]

    def blend(self, image: InputImage) -> Blend:
        """Return the blending of the views of an image."""
        blend: Blend = self.representation.blend if image.is_panorama else self._blend
        return blend

    def image_size(self, image: InputImage) -> tuple[int, int]:
        """Return rows and columns of the largest views of an image."""
        used = [self.representation] if image.is_panorama else self.crops
        return max(each.image_size for each in used)

    def description(self, area: Sequence[float] | None = None) -> str:
        """Return number and size of the views; of pinhole images also their angle and resolution.

        Args:
            area: Area that the panoramas show, see `check_area`; None for the whole sphere.
        """
        rows, columns = self.representation.image_size
        sets = self.representation.view_sets(PanoramaArea.on_canvas(area, _MASK_ROWS).valid)
        text = f"{counted(sum(map(len, sets)), 'views')} of {columns} × {rows}"
        grids = (views.grid for views in sets if isinstance(views, PinholeViews))
        parts = "; ".join(
            dict.fromkeys(
                f"{grid.width_deg:.0f}° wide, {math.radians(1 / grid.pitch):.1f} pixels per degree "
                "in the middle"
                for grid in grids
            )
        )
        return f"{text} ({parts})" if parts else text

    def __call__(self, image: InputImage) -> list[SourceViews]:
        """Return the views of the valid pixels of a panorama, or crops that cover a photo.

        Photos smaller than a crop are mirrored at their borders.
        """
        if not image.is_panorama:
            overlap = _OVERLAP if self._blend == "feather" else 0.0
            return [_covered(image, crops, overlap) for crops in self.crops]
        representation, rotation = self.representation, None
        if image.area is not None:
            image = replace(image, rgb=image.area.filled(image.rgb, self._fill))
        if image.up is not None:
            rotation = upright_rotation(image.up) if image.rotation is None else image.rotation
            representation = representation.with_rotation(rotation)
        rows = representation.erp_height
        shape = (rows, 2 * rows) if image.shape[0] > rows else image.shape
        return [SourceViews(image, shape, representation.view_sets(image.valid), rotation)]


def wide_levels(side: int) -> list[int]:
    """Return the levels of wide tangent images for photo networks.

    At level s and base level 0, 2^s pixels span 95.8°. The first level has the power of two nearest
    to the side. The second is the next lower level, at which the same number of pixels spans twice
    as much of the tangent plane. See docs/explanation/choosing_views.md.

    Args:
        side: Side of the network's images in pixels.

    >>> wide_levels(512), wide_levels(640), wide_levels(384)
    ([9, 8], [9, 8], [9, 8])
    """
    level = max(1, round(math.log2(side)))
    return [level, level - 1]


def images_of_side(side: int, level: int, base_level: int | None = None) -> dict[str, int]:
    """Choose base level and side of tangent images: the fewest with a given side.

    Args:
        side: Side of the network's images in pixels.
        level: Highest level s of the images.
        base_level: Base level b; None for the fewest images.

    Returns:
        ``base_level`` and ``dim``, which differs from `side` only if images of that side would
        leave gaps on the sphere.

    >>> images_of_side(512, 9), images_of_side(512, 10)
    ({'base_level': 0, 'dim': 512}, {'base_level': 1, 'dim': 512})
    """
    if base_level is None:  # a side of 2^(s−b−½) leaves no gaps
        base_level = max(0, math.ceil(level - math.log2(side) - 0.5))
    if not 0 <= base_level <= level:
        return {"base_level": base_level, "dim": side}  # refused by `TangentGrid`
    covers = side >= TangentGrid.least_dim(base_level, level)
    return {"base_level": base_level, "dim": side if covers else 2 ** (level - base_level)}


def view_settings(views: str | Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings of a representation of panoramas, without its level.

    Args:
        views: See `ViewChoice`.

    Raises:
        SettingError: There is no such option.
    """
    changes = {"option": views} if isinstance(views, str) else dict(views)
    option = str(changes.pop("option", None))
    files = sorted((config_folder() / "representation").glob("*.yaml"))
    known = {file.stem: file for file in files if not file.stem.startswith(_NOT_VIEWS)}
    check_choice("views", option, tuple(known))
    section: Any = OmegaConf.to_container(OmegaConf.load(known[option]))
    bases = [name for name in section.pop("defaults", ()) if name != "_self_"]
    inherited = view_settings(bases[0]) if bases else {}
    return {**inherited, **section, **changes, "level": None}


def photo_network_settings(
    side: int,
    levels: Levels = None,
    base_level: int | None = None,
    views: ViewChoice = None,
    camera: Mapping[str, Any] = MappingProxyType({}),
) -> dict[str, Any]:
    """Return the settings of the representation of panoramas for an imported photo network.

    Args:
        side: Side of the network's images in pixels.
        levels: See `Levels`; None for `wide_levels` of tangent images, and for the first of these
            of other views.
        base_level: Base level b of tangent images; None for the fewest images.
        views: See `ViewChoice`; None for `horizontal_wide`, or tangent images if levels or base
            level are given.
        camera: Settings of `horizontal_camera`, see `camera_settings`.

    Raises:
        SettingError: There are no such views.
    """
    is_default = levels is None and base_level is None
    views = views or (_VIEWS if is_default else "tangent")
    changes = {"option": views} if isinstance(views, str) else views
    is_camera = changes.get("option") == _CAMERA
    settings = view_settings({**camera, **changes} if is_camera else views)
    is_tangent = settings["_target_"] == _TANGENT
    usual = wide_levels(side)[: 2 if is_tangent else 1]
    if is_camera and camera:
        usual = [camera["level"]]
    chosen = usual if levels is None else level_list(levels, 0)
    settings["level"] = max(chosen)
    if not is_tangent:
        size = "rows" if settings["_target_"] == _EQUIRECT else "dim"
        settings[size] = settings[size] or side
        return settings | _only_of_tangent_images(chosen, base_level)
    if settings["dim"] is None and settings["crop_multiple"] is None:
        settings |= images_of_side(side, settings["level"], base_level)
    return settings | {"levels": chosen}


def camera_settings(
    fov_deg: tuple[float, float] | None, size: tuple[int, int], level: int | None
) -> dict[str, Any]:
    """Return the settings of `horizontal_camera` for a network's photos; none if they are unknown.

    Args:
        fov_deg: Horizontal and vertical field of view of the photos.
        size: Rows and columns of the photos.
        level: Level s with their pixels per degree.
    """
    return {} if fov_deg is None else {"fov": list(fov_deg), "dim": list(size), "level": level}


def _only_of_tangent_images(levels: Sequence[int], base_level: int | None) -> dict[str, Any]:
    """Return settings that other representations refuse."""
    given = {"base_level": base_level, "levels": levels if len(levels) > 1 else None}
    return {name: value for name, value in given.items() if value is not None}


def panorama_settings(
    loaded: LoadedNetwork,
    levels: Levels = None,
    base_level: int | None = None,
    views: ViewChoice = None,
) -> dict[str, Any]:
    """Return the settings of the representation of panoramas, see `ViewSelector`.

    Args:
        loaded: The network.
        levels: See `Levels`.
        base_level: Base level b of tangent images; None as trained.
        views: See `ViewChoice`.

    Raises:
        SettingError: There are no such views.
    """
    side, settings = loaded.photo_side, dict(loaded.representation)
    if side is not None and views is not None:
        size = loaded.fixed_size or (side, side)
        camera = camera_settings(loaded.photo_fov_deg, size, loaded.photo_level)
        return photo_network_settings(side, levels, base_level, views, camera)
    chosen = level_list(levels, loaded.level)
    level, was_tangent = max(chosen), settings["_target_"] == _TANGENT
    if views is not None:
        settings = view_settings(views)
    elif settings["_target_"] == PERSPECTIVE or (base_level is not None and not was_tangent):
        settings = {"_target_": _TANGENT, "base_level": _BASE_LEVEL}
    if level != loaded.level and views is None:
        settings |= {"erp_height": None} | ({"dim": None} if "dim" in settings else {})
    settings["level"] = level
    if settings["_target_"] != _TANGENT:
        if side is not None and "dim" in settings:
            settings["dim"] = settings["dim"] or side
        return settings | _only_of_tangent_images(chosen, base_level)
    if base_level not in (None, settings["base_level"]):
        settings |= {"base_level": base_level, "dim": None, "faces_per_panorama": None}
    if levels is not None:
        settings["levels"] = chosen if len(chosen) > 1 else None
    if side is not None:
        dim = settings.get("dim")
        # The network divides larger images.
        fewest = images_of_side(side, level, base_level)
        settings |= fewest if dim is None else {"dim": max(dim, side)}
    return settings


def _built(loaded: LoadedNetwork, settings: dict[str, Any]) -> Any:
    """Build a representation whose image size the network supports."""
    built = build_from_config(settings, "representation")
    check_size(loaded, built.image_size)
    return built


def _photo_representation(
    loaded: LoadedNetwork, level: int, base_level: int | None
) -> PerspectiveRepresentation:
    settings = loaded.representation
    if settings["_target_"] == PERSPECTIVE and base_level is None:
        half_extent = math.tan(math.radians(settings.get("fov_deg", 45.0)) / 2)
        half_extent /= 2.0 ** (level - loaded.level)
        size = loaded.image_size
    else:
        views = "tangent" if loaded.photo_level is not None else None
        seen = _built(loaded, panorama_settings(loaded, level, base_level, views))
        if not isinstance(seen, PinholeRepresentation):
            return _photo_representation(loaded, level, _BASE_LEVEL)
        size = seen.image_size
        half_extent = min(grid.half_size[0] for grid in seen.grids)
    check_size(loaded, size)
    return PerspectiveRepresentation(level, 2 * math.degrees(math.atan(half_extent)), size)


def check_size(loaded: LoadedNetwork, size: tuple[int, int]) -> None:
    """Refuse image sizes that a network does not support.

    Args:
        loaded: The network.
        size: Rows and columns of the images.

    Raises:
        SettingError: The network does not support the size.
    """
    if loaded.is_spherical:
        fits = size == loaded.image_size
        expected = f"{width_height(loaded.image_size)}, as in training: it labels whole panoramas"
    elif loaded.fixed_size is not None:
        fits = all(n >= least for n, least in zip(size, loaded.fixed_size, strict=True))
        expected = f"at least {width_height(loaded.fixed_size)}, the size in the network's file"
    else:
        fits = not any(side % loaded.size_multiple for side in size)
        expected = f"multiples of {loaded.size_multiple}, the network's stride"
    if not fits:
        found, remedy = f"images of {width_height(size)}", "Leave both and views as trained."
        raise SettingError("levels and base_level", found=found, expected=expected, remedy=remedy)


def _covered(image: InputImage, wanted: PerspectiveRepresentation, overlap: float) -> SourceViews:
    """Return crops that cover a photo; its borders are mirrored where a crop is larger.

    Args:
        image: The photo. Its z-depth is converted to distance.
        wanted: Common camera of the crops.
        overlap: See `PhotoSampler.cover`.
    """
    matrix, size = np.array(image.camera_matrix), image.rgb.shape[:2]
    depth = None if image.depth is None else distance_from_z_depth(image.depth, matrix)
    pixel = 2 * math.tan(math.radians(wanted.fov_deg) / 2) / wanted.image_size[1]
    per_pixel = pixel * np.diag(matrix)[[1, 0]]  # photo pixels per crop pixel, down and across
    # Resized first: mirrored at full resolution, a photo of a tiny field of view fills the memory.
    kept = np.minimum(1, _OVERSAMPLED / per_pixel)
    rows, columns = (max(1, round(n * share)) for n, share in zip(size, kept, strict=True))
    scale = np.array([columns / size[1], rows / size[0]])
    least = np.ceil(wanted.image_size * per_pixel * scale[::-1] + 1e-6)
    top, left = (math.ceil(max(0, a - b) / 2) for a, b in zip(least, (rows, columns), strict=True))
    borders = (top, top, left, left, cv2.BORDER_REFLECT_101)
    rgb = cv2.copyMakeBorder(resize(image.rgb, (rows, columns), "bilinear"), *borders)
    if depth is not None:
        depth = cv2.copyMakeBorder(resize_depth(depth, (rows, columns)), *borders)
    offset, factor = np.tile((left, top), 2), np.tile(scale, 2)
    camera = np.diag([*np.diag(matrix)[:2] * scale, 1])
    camera[:2, 2] = (matrix[:2, 2] + 0.5) * scale + (left, top) - 0.5
    mirrored = InputImage(rgb, depth)
    crops = wanted.of_camera(camera, mirrored.shape).cover(overlap)
    in_photo = replace(crops, canvas_boxes=(crops.boxes - offset) / factor)
    return SourceViews(mirrored, mirrored.shape, [in_photo])
