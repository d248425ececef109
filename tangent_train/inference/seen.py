"""What a trained network is shown of images it was not trained on."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from tangent_train.errors import SettingError
from tangent_train.registry import make
from tangent_train.rendering import PerspectiveRepresentation
from tangent_train.rendering.representations.pinhole import PinholeRepresentation

if TYPE_CHECKING:
    from tangent_train.checkpoints.trained import TrainedNetwork
    from tangent_train.rendering import EquirectRepresentation

__all__ = ["panorama_representation", "photo_representation"]

_PREFIX = "tangent_train.rendering."
_TANGENT = _PREFIX + "TangentRepresentation"
_PERSPECTIVE = _PREFIX + "PerspectiveRepresentation"

_BASE_LEVEL_FOR_PHOTOS = 1
"""Base level for networks trained on photos (paper, section 5: transfer uses b = 1)."""


def panorama_representation(
    trained: TrainedNetwork, level: int | None = None, base_level: int | None = None
) -> PinholeRepresentation | EquirectRepresentation:
    """What the network is shown of a panorama: as it was trained, if nothing else is asked for.

    Networks trained on photos see tangent images of base level 1 and of the level whose angular
    resolution their crops had.

    Args:
        trained: The network.
        level: Another level s: the angular resolution changes.
        base_level: Tangent images of another base level b.

    Raises:
        SettingError: The network cannot take the images.
    """
    settings: dict[str, Any] = dict(trained.representation)
    kind = settings["_target_"]
    if kind == _PERSPECTIVE or (base_level is not None and kind != _TANGENT):
        settings = {"_target_": _TANGENT, "base_level": _BASE_LEVEL_FOR_PHOTOS}
    if settings["_target_"] == _TANGENT and base_level not in (None, settings["base_level"]):
        settings |= {"base_level": base_level, "dim": None, "faces_per_panorama": None}
    if level not in (None, trained.level):
        settings |= {"erp_height": None} | ({"dim": None} if "dim" in settings else {})
    settings["level"] = trained.level if level is None else level
    representation: PinholeRepresentation | EquirectRepresentation = make(
        settings, "representation", trained.trust
    )
    _check_size(trained, representation.image_size)
    return representation


def photo_representation(
    trained: TrainedNetwork, level: int | None = None, base_level: int | None = None
) -> PerspectiveRepresentation:
    """Crops of photos with the size and angular resolution of what the network was trained on.

    Args:
        trained: The network.
        level: Another level s: the angular resolution changes.
        base_level: Crops of the size of tangent images of another base level b.

    Raises:
        SettingError: The network cannot take the crops.
    """
    wanted = trained.level if level is None else level
    settings = trained.representation
    if settings["_target_"] == _PERSPECTIVE and base_level is None:
        finer = 2.0 ** (wanted - trained.level)
        extent = math.tan(math.radians(settings.get("fov_deg", 45.0)) / 2) / finer
        fov_deg, size = 2 * math.degrees(math.atan(extent)), trained.image_size
    else:
        seen = panorama_representation(trained, level, base_level)
        if not isinstance(seen, PinholeRepresentation):
            return photo_representation(trained, level, _BASE_LEVEL_FOR_PHOTOS)
        size = seen.image_size
        fov_deg = 2 * math.degrees(math.atan(seen.grid.dim / 2 * seen.grid.pitch))
    _check_size(trained, size)
    return PerspectiveRepresentation(wanted, fov_deg, size)


def _check_size(trained: TrainedNetwork, size: tuple[int, int]) -> None:
    rows, columns = size
    fixed = trained.fixed_size
    if fixed is not None and fixed != size:
        raise SettingError(
            "level and base_level",
            found=f"images of {rows}×{columns}",
            expected=f"those of {fixed[0]}×{fixed[1]} that the file of the network takes",
            remedy="Leave level and base_level as trained, or use the network's checkpoint.",
        )
    multiple = trained.size_multiple
    if rows % multiple or columns % multiple:
        raise SettingError(
            "level and base_level",
            found=f"images of {rows}×{columns}",
            expected=f"multiples of {multiple}, as the network needs",
            remedy="Choose a higher level or a lower base level.",
        )
