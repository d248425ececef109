"""SynthRooms as data modules: Stanford2D3DS's own, after making the files."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from datamodules.stanford2d3ds.panoramas import Stanford2D3DS
from datamodules.stanford2d3ds.perspective import Stanford2D3DSPerspective
from datamodules.synthrooms.settings import RoomSettings, ViewKind
from tangent_train.errors import SettingError
from tangent_train.registry import registered

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from tangent_train.rendering.representations.perspective import PerspectiveRepresentation
    from tangent_train.rendering.representations.pinhole import Representation

__all__ = ["SynthRooms", "SynthRoomsPerspective"]


@registered
class SynthRooms(Stanford2D3DS):
    """Rooms made on the first use, read as Stanford2D3DS: the data set that needs no download.

    Args:
        root: Folder for the files.
        representation: What the network sees of a panorama.
        rooms: Which rooms to make; their areas are the areas used.
        **settings: All others of `Stanford2D3DS`.

    Raises:
        SettingError: A setting that cannot work.
    """

    is_made = True

    def __init__(
        self,
        root: str | Path,
        representation: Representation,
        rooms: RoomSettings | Mapping[str, int | ViewKind | Mapping[str, int]],
        **settings: Any,
    ) -> None:
        self.rooms = _room_settings(rooms)
        super().__init__(root, representation, areas=_areas(self.rooms), **settings)

    def make_files(self) -> None:
        """Make the files, unless they are there."""
        _make_files(self.root, self.rooms)


@registered
class SynthRoomsPerspective(Stanford2D3DSPerspective):
    """Photos of the same rooms, read as those of Stanford2D3DS.

    Args:
        root: Folder for the files, which may be that of `SynthRooms` of the same rooms.
        representation: The camera that all photos are brought to.
        rooms: Which rooms to make, with photos; their areas are the areas used.
        **settings: All others of `Stanford2D3DSPerspective`.

    Raises:
        SettingError: A setting that cannot work.
    """

    is_made = True

    def __init__(
        self,
        root: str | Path,
        representation: PerspectiveRepresentation,
        rooms: RoomSettings | Mapping[str, int | ViewKind | Mapping[str, int]],
        **settings: Any,
    ) -> None:
        self.rooms = _room_settings(rooms)
        if not self.rooms.views_per_camera:
            raise SettingError("data.rooms.views_per_camera", found=0, expected="1 or more photos")
        super().__init__(root, representation, areas=_areas(self.rooms), **settings)

    def make_files(self) -> None:
        """Make the files, unless they are there."""
        _make_files(self.root, self.rooms)


def _room_settings(rooms: RoomSettings | Mapping[str, Any]) -> RoomSettings:
    return rooms if isinstance(rooms, RoomSettings) else RoomSettings(**rooms)


def _areas(rooms: RoomSettings) -> list[str]:
    return [area for area, count in rooms.rooms.items() if count]


def _make_files(root: Path, rooms: RoomSettings) -> None:
    from datamodules.synthrooms.generate import generate_rooms

    generate_rooms(root, rooms)
