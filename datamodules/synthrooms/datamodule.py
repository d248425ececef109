"""SynthRooms as data modules: those of Stanford2D3DS, after generating the files."""

from __future__ import annotations

from dataclasses import field
from typing import Any

from datamodules.core.data_module import data_set
from datamodules.stanford2d3ds.pairs import StanfordPairs
from datamodules.stanford2d3ds.panoramas import (
    Stanford2D3DS,
    Stanford2D3DSPerspective,
    StanfordImages,
)
from datamodules.synthrooms.generate import RoomSettings, generate_rooms
from tangent_train.errors import SettingError


@data_set
class SynthRoomsImages(StanfordImages):
    """Images of synthetic rooms, generated on first use.

    Args:
        rooms: Rooms to generate; their areas are the areas used.
    """

    areas: Any = field(init=False, default=())
    rooms: RoomSettings

    def __post_init__(self) -> None:
        self.areas = self.rooms.areas
        super().__post_init__()

    def make_files(self) -> None:
        """Generate the files, unless they are there."""
        generate_rooms(self.root, self.rooms)


@data_set
class SynthRooms(SynthRoomsImages, Stanford2D3DS):
    """Panoramas of synthetic rooms, read as Stanford2D3DS: the data set that needs no download."""


@data_set
class SynthRoomsPerspective(SynthRoomsImages, Stanford2D3DSPerspective):
    """Photos of synthetic rooms, read as those of Stanford2D3DS."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.rooms.views_per_camera:
            raise SettingError("data.rooms.views_per_camera", found=0, expected="1 or more photos")


@data_set
class SynthRoomsPairs(StanfordPairs):
    """Any two panoramas of the same synthetic room, with exact depth and pose.

    Pairs are not divided into easy and hard, because overlaps are known only afterwards.

    Args:
        rooms: Rooms to generate, with two cameras or more.
    """

    selection: Any = field(init=False, default="rooms")
    areas: Any = field(init=False, default=None)
    rooms: RoomSettings

    def make_files(self) -> None:
        """Generate the files, unless they are there."""
        generate_rooms(self.root, self.rooms)
