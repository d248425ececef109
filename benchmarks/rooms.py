"""Made panoramas that several benchmarks read, in Stanford2D3DS's format."""

from __future__ import annotations

import shutil
import tempfile
from atexit import register
from functools import cache
from pathlib import Path

from datamodules.stanford2d3ds.files import AREAS as ALL_AREAS
from datamodules.stanford2d3ds.files import FileName
from datamodules.synthrooms.generate import generate_rooms
from datamodules.synthrooms.settings import RoomSettings

__all__ = ["AREAS", "few_rooms", "made_rooms"]

AREAS = ("1", "5a")
"""One to train on, one to test."""


@cache
def made_rooms(height: int, copies: int = 1) -> Path:
    """A folder of a few panoramas, until this process ends.

    Args:
        height: Their rows.
        copies: Names of every panorama.
    """
    folder = Path(tempfile.mkdtemp(prefix="benchmarks-"))
    register(shutil.rmtree, folder, ignore_errors=True)
    rooms = dict(zip(AREAS, (3, 1), strict=True))
    generate_rooms(folder, RoomSettings(rooms=rooms, height=height, supersample=1))
    for path in sorted(folder.glob("area_*/pano/*/*.png")):
        name = FileName.parse(path.name)
        for copy in range(1, copies):
            camera = f"{copy:x}{name.camera[1:]}"
            path.with_name(str(name._replace(camera=camera))).hardlink_to(path)
    return folder


def few_rooms(root: Path, height: int) -> list[str]:
    """Settings of ``data=synthrooms``: a few rooms with eight panoramas each.

    Args:
        root: Where they are made.
        height: Rows of the panoramas.
    """
    counts = dict(zip(AREAS, (6, 1), strict=True))
    rooms = [f"data.rooms.rooms.area_{area}={counts.get(area, 0)}" for area in ALL_AREAS]
    size = [f"data.rooms.height={height}", "+data.rooms.least_cameras=8"]
    return [*rooms, *size, f"data.root={root}"]
