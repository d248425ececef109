"""Pairs of panoramas of made rooms: exact depth and pose, no download."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from datamodules.stanford2d3ds.pairs import StanfordPairs
from datamodules.synthrooms.settings import RoomSettings
from tangent_train.errors import SettingError

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

__all__ = ["SynthRoomsPairs"]


class SynthRoomsPairs(StanfordPairs):
    """Any two panoramas of the same room, of rooms that are made on the first use.

    They are read as those of Stanford2D3DS. There is no split: overlaps are known only afterwards.

    Args:
        root: Folder for the files.
        rooms: Which rooms to make, with two cameras or more.
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
        self.rooms = rooms if isinstance(rooms, RoomSettings) else RoomSettings(**rooms)
        if self.rooms.least_cameras < 2:
            raise SettingError(
                "data.rooms.least_cameras", found=self.rooms.least_cameras, expected="2 or more"
            )
        areas = [area for area, count in self.rooms.rooms.items() if count]
        super().__init__(root, "rooms", areas, erp_height)

    def make_files(self) -> None:
        """Make the rooms, unless they are there."""
        from datamodules.synthrooms.generate import generate_rooms

        generate_rooms(self.root, self.rooms)
