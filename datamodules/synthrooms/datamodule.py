"""SynthRooms as data modules: those of Stanford2D3DS, after generating the files."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from datamodules.core.data_module import data_set
from datamodules.core.images import ImageFiles
from datamodules.core.splits import Split
from datamodules.stanford2d3ds.pairs import StanfordPairs
from datamodules.stanford2d3ds.panoramas import (
    Stanford2D3DS,
    Stanford2D3DSPerspective,
    StanfordAreas,
)
from datamodules.synthrooms.generate import RoomSettings, generate_rooms
from tangent_train.errors import DataError, SettingError


@data_set
class SynthRoomsAreas(StanfordAreas):
    """Areas of synthetic rooms, generated on first use.

    Args:
        rooms: Rooms to generate; their areas are the areas used.
    """

    rooms: Any

    def __post_init__(self) -> None:
        self.rooms = rooms = RoomSettings.of(self.rooms)
        self.areas = rooms.areas
        super().__post_init__()

    def make_files(self) -> None:
        """Generate the files, unless they are there."""
        generate_rooms(self.root, RoomSettings.of(self.rooms))

    def files(self, split: Split) -> list[ImageFiles]:
        """See `DataModule`."""
        if not self.root.is_dir():
            remedy = "Run tangent-prepare with the same settings."
            raise DataError(self.root, found="no such folder", expected="rooms", remedy=remedy)
        return super().files(split)


@data_set
class SynthRooms(SynthRoomsAreas, Stanford2D3DS):
    """Panoramas of synthetic rooms, read as Stanford2D3DS: the data set that needs no download."""


@data_set
class SynthRoomsPerspective(SynthRoomsAreas, Stanford2D3DSPerspective):
    """Photos of synthetic rooms, read as those of Stanford2D3DS."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not RoomSettings.of(self.rooms).views_per_camera:
            raise SettingError("data.rooms.views_per_camera", found=0, expected="1 or more photos")


class SynthRoomsPairs(StanfordPairs):
    """Any two panoramas of the same synthetic room, with exact depth and pose.

    Pairs are not divided into easy and hard, because overlaps are known only afterwards.

    Args:
        root: Folder for the files.
        rooms: Rooms to generate, with two cameras or more.
        erp_height: See `StanfordPairs`.
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
        generate_rooms(self.root, self.rooms)
