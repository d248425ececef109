"""SynthRooms as data modules: Stanford2D3DS's own, after generating the files."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from datamodules.stanford2d3ds.pairs import StanfordPairs
from datamodules.stanford2d3ds.panoramas import Stanford2D3DS
from datamodules.stanford2d3ds.perspective import Stanford2D3DSPerspective
from datamodules.synthrooms.settings import RoomSettings
from tangent_train.errors import SettingError
from tangent_train.registry import registered

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

__all__ = ["SynthRooms", "SynthRoomsPairs", "SynthRoomsPerspective"]


class _Rooms:
    """Rooms that are generated on first use."""

    root: Path
    rooms: RoomSettings
    is_made = True

    def make_files(self) -> None:
        """Generate the files, unless they are there."""
        from datamodules.synthrooms.generate import generate_rooms

        generate_rooms(self.root, self.rooms)


@registered
class SynthRooms(_Rooms, Stanford2D3DS):
    """Panoramas of synthetic rooms, read as Stanford2D3DS: the data set that needs no download.

    Args:
        root: Folder for the files.
        representation: What the network sees of a panorama.
        rooms: Which rooms to generate; their areas are the areas used.
        **settings: All others of `Stanford2D3DS`.

    Raises:
        SettingError: A setting that cannot work.
    """

    def __init__(
        self,
        root: str | Path,
        representation: Any,
        rooms: RoomSettings | Mapping[str, Any],
        **settings: Any,
    ) -> None:
        self.rooms = RoomSettings.of(rooms)
        super().__init__(root, representation, areas=self.rooms.areas, **settings)


@registered
class SynthRoomsPerspective(_Rooms, Stanford2D3DSPerspective):
    """Photos of the same rooms, read as those of Stanford2D3DS.

    Args:
        root: Folder for the files, which may be that of `SynthRooms` of the same rooms.
        representation: The camera that all photos are brought to.
        rooms: Which rooms to generate, with photos; their areas are the areas used.
        **settings: All others of `Stanford2D3DSPerspective`.

    Raises:
        SettingError: A setting that cannot work.
    """

    def __init__(
        self,
        root: str | Path,
        representation: Any,
        rooms: RoomSettings | Mapping[str, Any],
        **settings: Any,
    ) -> None:
        self.rooms = RoomSettings.of(rooms)
        if not self.rooms.views_per_camera:
            raise SettingError("data.rooms.views_per_camera", found=0, expected="1 or more photos")
        super().__init__(root, representation, areas=self.rooms.areas, **settings)


class SynthRoomsPairs(_Rooms, StanfordPairs):
    """Any two panoramas of the same synthetic room, with exact depth and pose.

    There are no easy and hard pairs: overlaps are known only afterwards.

    Args:
        root: Folder for the files.
        rooms: Which rooms to generate, with two cameras or more.
        erp_height: See `StanfordPairs`.

    Raises:
        SettingError: A setting that cannot work.
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
