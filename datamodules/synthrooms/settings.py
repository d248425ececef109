"""Settings of a SynthRooms data set."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, get_args

from datamodules.stanford2d3ds.files import AREAS
from tangent_train.errors import SettingError

__all__ = ["RoomSettings", "ViewKind"]

ViewKind = Literal["stanford", "uniform"]

_LEAST = {"height": 8, "view_size": 8, "supersample": 1, "least_cameras": 1}


@dataclass(frozen=True)
class RoomSettings:
    """Settings of a data set; the same settings give the same bytes.

    Attributes:
        seed: Seed of everything, 0 or more.
        rooms: Number of rooms per area (a subset of `AREAS`, also written ``area_5a``).
        height: Rows of the panoramas; they have twice as many columns.
        views: Viewing directions of photos: ``"stanford"`` upright as in the real set (pitch
            about N(0, 20°)), ``"uniform"`` in directions uniform on the sphere.
        views_per_camera: Perspective views per panorama.
        view_size: Side of the square perspective views in pixels.
        supersample: Rays per pixel side for the colours (labels and depth: one ray at the centre).
        least_cameras: Least number of panoramas per room; most rooms have one otherwise.

    Raises:
        SettingError: A setting is invalid.
    """

    seed: int = 0
    rooms: Mapping[str, int] = field(
        default_factory=lambda: {a: 16 if a[0] == "5" else 40 for a in AREAS}
    )
    height: int = 512
    views: ViewKind = "stanford"
    views_per_camera: int = 0
    view_size: int = 540
    supersample: int = 2
    least_cameras: int = 1

    @classmethod
    def of(cls, given: RoomSettings | Mapping[str, Any]) -> RoomSettings:
        """Settings from a config."""
        return given if isinstance(given, RoomSettings) else cls(**given)

    def __post_init__(self) -> None:
        rooms = {str(area).removeprefix("area_"): count for area, count in self.rooms.items()}
        if not set(rooms) <= set(AREAS) or not any(rooms.values()):
            raise SettingError("rooms", found=rooms, expected=f"numbers of rooms by area: {AREAS}")
        object.__setattr__(self, "rooms", {area: rooms[area] for area in AREAS if area in rooms})
        if self.views not in get_args(ViewKind):
            raise SettingError("views", found=self.views, expected=get_args(ViewKind))
        numbers = {f"rooms[{area}]": count for area, count in rooms.items()}
        names = ("seed", "views_per_camera", *_LEAST)
        for name, value in {**numbers, **{name: getattr(self, name) for name in names}}.items():
            least = _LEAST.get(name, 0)
            if type(value) is not int or value < least:
                raise SettingError(name, found=value, expected=f"an integer of {least} or more")

    @property
    def areas(self) -> list[str]:
        """The areas that have rooms."""
        return [area for area, count in self.rooms.items() if count]
