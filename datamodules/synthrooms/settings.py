"""What a SynthRooms data set consists of."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any, Literal, get_args

from datamodules.stanford2d3ds.files import AREAS
from tangent_train.errors import SettingError

if TYPE_CHECKING:
    from collections.abc import Mapping

__all__ = ["RoomSettings", "ViewKind"]

ViewKind = Literal["stanford", "uniform"]


def _default_rooms() -> dict[str, int]:
    return {"1": 40, "2": 40, "3": 40, "4": 40, "5a": 16, "5b": 16, "6": 40}


@dataclass(frozen=True)
class RoomSettings:
    """Settings of a data set; the same settings give the same bytes.

    Attributes:
        seed: Seed of everything, 0 or more.
        rooms: Number of rooms per area (a subset of `AREAS`, also written ``area_5a``).
        height: Rows of the panoramas; they have twice as many columns.
        views: How perspective views look around: ``"stanford"`` upright like the real set's (pitch
            about N(0, 20°)), ``"uniform"`` in directions uniform on the sphere.
        views_per_camera: Perspective views per panorama.
        view_size: Side of the square perspective views in pixels.
        supersample: Rays per pixel side for the colours (labels and depth: one ray at the centre).
        least_cameras: Panoramas that every room has at least; most have no more than one otherwise.

    Raises:
        SettingError: A setting that cannot work.
    """

    seed: int = 0
    rooms: Mapping[str, int] = field(default_factory=_default_rooms)
    height: int = 512
    views: ViewKind = "stanford"
    views_per_camera: int = 0
    view_size: int = 540
    supersample: int = 2
    least_cameras: int = 1

    def __post_init__(self) -> None:
        rooms = {str(area).removeprefix("area_"): n for area, n in self.rooms.items()}
        unknown = sorted(set(rooms) - set(AREAS))
        if unknown or not rooms:
            raise SettingError("rooms", found=unknown or "no area", expected=f"areas of {AREAS}")
        for area, count in rooms.items():
            _check_integer(f"rooms[{area}]", count, least=0)
        if not any(rooms.values()):
            raise SettingError("rooms", found=rooms, expected="one room at least")
        object.__setattr__(self, "rooms", {area: rooms[area] for area in AREAS if area in rooms})
        if self.views not in get_args(ViewKind):
            raise SettingError("views", found=self.views, expected=get_args(ViewKind))
        limits = {"seed": 0, "height": 8, "views_per_camera": 0, "view_size": 8, "supersample": 1}
        limits["least_cameras"] = 1
        for name, least in limits.items():
            _check_integer(name, getattr(self, name), least=least)

    def as_dict(self) -> dict[str, Any]:
        """The settings as plain values, for JSON."""
        settings = asdict(self)
        if self.least_cameras == 1:
            del settings["least_cameras"]  # data sets made before it was a setting are the same
        return settings


def _check_integer(name: str, value: object, *, least: int) -> None:
    if isinstance(value, bool) or not isinstance(value, int) or value < least:
        raise SettingError(name, found=value, expected=f"an integer of {least} or more")
