"""Homes of ZInD: the panoramas in ``zind_data.json``.

Its ``merger`` is read: floors contain complete rooms, these contain partial rooms, and these
contain panoramas. Lengths are in camera heights. A point x of a panorama is at
``scale · R(rotation) x + translation`` of its floor, in units of ``scale_meters_per_coordinate``
meters, which is null where unknown.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, NamedTuple

import cv2
import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from datamodules.core.files import Problems
from datamodules.zind.layout import DOOR, OPENING, WINDOW, Fixture, Layout
from tangent_train.errors import DataError
from tangent_train.files import read_json
from tangent_train.geometry import PanoramaPose, rotation_about
from tangent_train.io.image_files import glob_files

GET_IT = "Get the sample tour from https://github.com/zillow/zind, or request the whole set there."
_FROM_SPHERE = np.array([[0, -1.0, 0], [1.0, 0, 0], [0, 0, 1.0]])
"""Axes of a panorama (x to the middle, y right, z up) to ZInD's (x left, y to the middle, z up)."""

_Length = Annotated[float, Field(gt=0, allow_inf_nan=False)]
_Point = tuple[float, float]
_Name = Annotated[str, Field(pattern=r"^\w+$")]


class LayoutRecord(BaseModel):
    """Visible part of a room: corners, and the ends and [bottom, top] of each fixture."""

    vertices: list[_Point]
    openings: list[_Point]
    doors: list[_Point]
    windows: list[_Point]


class PlaceRecord(BaseModel):
    """Place of a panorama on its floor; the angle is in degrees."""

    rotation: float
    scale: _Length
    translation: _Point


class PanoramaRecord(BaseModel):
    """Record of a panorama, of which the rest is not read."""

    model_config = ConfigDict(allow_inf_nan=False)

    camera_height: _Length
    ceiling_height: _Length
    floor_plan_transformation: PlaceRecord
    image_path: Annotated[str, Field(pattern=r"^panos/[^/\\]+$")]
    is_inside: bool = False
    layout_visible: LayoutRecord | None = None


class _HomeRecord(BaseModel):
    merger: dict[_Name, dict[_Name, dict[_Name, dict[_Name, PanoramaRecord]]]]
    scale_meters_per_coordinate: dict[_Name, _Length | None]


class HomePanorama(NamedTuple):
    """A panorama of a home, as described in its file.

    Attributes:
        file: ``zind_data.json``.
        room: Complete room, e.g. ``000/floor_01/complete_room_06``.
        name: Name, e.g. ``000/floor_01/complete_room_06/partial_room_09/pano_5``.
        record: Record of the panorama in the file.
        unit_m: Meters per unit of the floor; None if unknown.
    """

    file: Path
    room: str
    name: str
    record: PanoramaRecord
    unit_m: float | None

    @property
    def home(self) -> str:
        """Name of the home, e.g. ``000``."""
        return self.file.parent.name

    @property
    def rgb(self) -> Path:
        """Path of the picture."""
        return self.file.parent / self.record.image_path

    def layout(self) -> Layout:
        """Return the visible part of the room.

        Raises:
            DataError: The layout does not surround the camera.
        """
        seen, floor_z = self.record.layout_visible, -self.record.camera_height
        vertices = np.array(seen.vertices if seen else [], np.float64).reshape(-1, 2)
        polygon = vertices.astype(np.float32)
        if seen is None or cv2.pointPolygonTest(polygon, (0, 0), measureDist=False) <= 0:
            raise DataError(self.file, found=f"{seen}", expected=f"a room around {self.name}")
        kinds = ((seen.openings, OPENING), (seen.doors, DOOR), (seen.windows, WINDOW))
        fixtures = [
            Fixture(np.stack(ends), bottom_z, top_z, label)
            for points, label in kinds
            for *ends, (bottom_z, top_z) in np.array(points, np.float64).reshape(-1, 3, 2)
        ]
        return Layout(vertices, floor_z, self.record.ceiling_height + floor_z, fixtures)

    def pose(self) -> tuple[PanoramaPose, float]:
        """Return the pose on its floor (height 0), and the camera height in meters."""
        place = self.record.floor_plan_transformation
        unit_m = self.unit_m or math.nan
        rotation = rotation_about((0, 0, 1), math.radians(place.rotation))
        height = place.scale * self.record.camera_height
        location_m = np.array([*place.translation, height]) * unit_m
        return PanoramaPose(rotation @ _FROM_SPHERE, location_m), unit_m * place.scale


def list_home_panoramas(root: Path, problems: Problems) -> list[HomePanorama]:
    """List the panoramas of all homes, in order.

    Args:
        root: Folder with a folder for every home.
        problems: Collects unreadable files.
    """
    found: list[HomePanorama] = []
    for file in glob_files(root, "*/zind_data.json"):
        with problems.noted(file.parent.name, file):
            home = read_json(file, "zind_data.json as released", kind=_HomeRecord)
            units_m = home.scale_meters_per_coordinate
            found += [
                HomePanorama(file, room, f"{room}/{part}/{name}", record, units_m[floor])
                for floor, rooms in home.merger.items()
                for room_name, parts in rooms.items()
                for room in [f"{file.parent.name}/{floor}/{room_name}"]
                for part, panoramas in parts.items()
                for name, record in panoramas.items()
            ]
    return found
