"""SynthRooms as a data module: Stanford2D3DS's own, after making the files."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from datamodules.stanford2d3ds import Stanford2D3DS
from datamodules.synthrooms.settings import RoomSettings

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from tangent_train.rendering.representation import Representation

__all__ = ["SynthRooms"]


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

    def __init__(
        self,
        root: str | Path,
        representation: Representation,
        rooms: RoomSettings | Mapping[str, Any],
        **settings: Any,
    ) -> None:
        self.rooms = rooms if isinstance(rooms, RoomSettings) else RoomSettings(**rooms)
        areas = [area for area, count in self.rooms.rooms.items() if count]
        super().__init__(root, representation, areas=areas, **settings)

    def make_files(self) -> None:
        """Make the files, unless they are there."""
        from datamodules.synthrooms.generate import generate_rooms

        generate_rooms(self.root, self.rooms)
