"""SynthRooms as data modules: Stanford2D3DS's own, after generating the files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from datamodules.stanford2d3ds.pairs import StanfordPairs
from datamodules.stanford2d3ds.panoramas import Stanford2D3DS
from datamodules.stanford2d3ds.perspective import Stanford2D3DSPerspective
from datamodules.synthrooms.settings import RoomSettings
from tangent_train.errors import SettingError
from tangent_train.registry import registered

if TYPE_CHECKING:
    from pathlib import Path

__all__ = ["SynthRooms", "SynthRoomsPairs", "SynthRoomsPerspective"]


def _generate(root: Path, rooms: Any) -> None:
    """Generate the files, unless they are there."""
    from datamodules.synthrooms.generate import generate_rooms

    generate_rooms(root, rooms)


@registered
@dataclass(kw_only=True, eq=False, repr=False)
class SynthRooms(Stanford2D3DS):
    """Panoramas of synthetic rooms, read as Stanford2D3DS: the data set that needs no download.

    Args:
        rooms: Rooms to generate; their areas are the areas used.

    Raises:
        SettingError: A setting is invalid.
    """

    is_made = True

    areas: Sequence[str] = field(init=False, default=())
    rooms: RoomSettings | Mapping[str, int | str | Mapping[str, int]]

    def __post_init__(self) -> None:
        self.rooms = rooms = RoomSettings.of(self.rooms)
        self.areas = rooms.areas
        super().__post_init__()

    def make_files(self) -> None:
        """Generate the files, unless they are there."""
        _generate(self.root, self.rooms)


@registered
@dataclass(kw_only=True, eq=False, repr=False)
class SynthRoomsPerspective(Stanford2D3DSPerspective):
    """Photos of the same rooms, read as those of Stanford2D3DS.

    Args:
        rooms: Rooms to generate, with photos; their areas are the areas used.

    Raises:
        SettingError: A setting is invalid.
    """

    is_made = True

    areas: Sequence[str] = field(init=False, default=())
    rooms: RoomSettings | Mapping[str, int | str | Mapping[str, int]]

    def __post_init__(self) -> None:
        self.rooms = rooms = RoomSettings.of(self.rooms)
        if not rooms.views_per_camera:
            raise SettingError("data.rooms.views_per_camera", found=0, expected="1 or more photos")
        self.areas = rooms.areas
        super().__post_init__()

    def make_files(self) -> None:
        """Generate the files, unless they are there."""
        _generate(self.root, self.rooms)


class SynthRoomsPairs(StanfordPairs):
    """Any two panoramas of the same synthetic room, with exact depth and pose.

    There are no easy and hard pairs: overlaps are known only afterwards.

    Args:
        root: Folder for the files.
        rooms: Rooms to generate, with two cameras or more.
        erp_height: See `StanfordPairs`.

    Raises:
        SettingError: A setting is invalid.
    """

    def __init__(
        self,
        root: str | Path,
        rooms: RoomSettings | Mapping[str, Any],
        erp_height: int | None = None,
    ) -> None:
        self.rooms = RoomSettings.of(rooms)
        if self.rooms.least_cameras < 2:
            raise SettingError(
                "data.rooms.least_cameras", found=self.rooms.least_cameras, expected="2 or more"
            )
        super().__init__(root, "rooms", self.rooms.areas, erp_height)

    def make_files(self) -> None:
        """Generate the files, unless they are there."""
        _generate(self.root, self.rooms)
