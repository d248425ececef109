"""Homes of ZInD: the panoramas in ``zind_data.json``.

Its ``merger`` is read: floors contain complete rooms, these contain partial rooms, and these
contain panoramas. Lengths are in camera heights. A point x of a panorama is at
``scale · R(rotation) x + translation`` of its floor, in units of ``scale_meters_per_coordinate``
meters, which is null where unknown.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datamodules.core.problems import Problems
from datamodules.zind.layout import DOOR, OPENING, WINDOW, Fixture, Layout
from tangent_train.config.build import Text, check_fields
from tangent_train.errors import DataError
from tangent_train.files import read_json
from tangent_train.geometry import PanoramaPose, rotation_about

_GET_IT = (
    "Get the sample tour from https://github.com/zillow/zind or request the whole set there, and "
    "point data.root at the folder that holds the homes (sample_tour)."
)
_EXPECTED = "zind_data.json as released"
_COPY = "Copy or extract the file again."
_LEVELS = 4  # floors, complete rooms, partial rooms, panoramas
_NAME = re.compile(r"\w+", re.ASCII)
_MOST = 1e6  # camera heights
_HEIGHTS = ("camera_height", "ceiling_height")
_READ = (*_HEIGHTS, "floor_plan_transformation", "image_path", "is_inside", "layout_visible")
_FIXTURES = {"openings": OPENING, "doors": DOOR, "windows": WINDOW}
_POINTS = list[list[float]]
_FROM_SPHERE = np.array([[0, -1.0, 0], [1.0, 0, 0], [0, 0, 1.0]])
"""Axes of a panorama (x to the middle, y right, z up) to ZInD's (x left, y to the middle, z up)."""


@dataclass(frozen=True, eq=False)
class HomePanorama:
    """A panorama of a home, as described in its file.

    Attributes:
        file: ``zind_data.json``.
        path: Names of floor, complete room, partial room and panorama.
        record: Record of the panorama in the file.
        unit_m: Meters per unit of the floor; None if unknown.
    """

    file: Path
    path: tuple[str, ...]
    record: Mapping[str, Any]
    unit_m: float | None

    @property
    def name(self) -> str:
        """Name, e.g. ``000/floor_01/complete_room_06/partial_room_09/pano_5``."""
        return "/".join((self.home, *self.path))

    @property
    def home(self) -> str:
        """Name of the home, e.g. ``000``."""
        return self.file.parent.name

    @property
    def room(self) -> str:
        """Complete room, e.g. ``000/floor_01/complete_room_06``."""
        return "/".join((self.home, *self.path[:2]))

    @property
    def has_layout(self) -> bool:
        """True if the file describes the visible part of the room."""
        return self.record.get("layout_visible") is not None

    @property
    def is_inside(self) -> bool:
        """True if the camera is inside the partial room."""
        return self.record.get("is_inside") is True

    def image(self) -> Path:
        """Return the path of the picture.

        Raises:
            DataError: The file does not name a picture in ``panos``.
        """
        path = PurePosixPath(self._fields({"image_path": Text})["image_path"])
        if path.parent != PurePosixPath("panos"):
            raise self._wrong(f"image_path={path}", "panos/….jpg")
        return self.file.parent / path

    def layout(self) -> Layout:
        """Return the visible part of the room.

        Raises:
            DataError: The file does not describe a room around the camera.
        """
        heights = self._fields(dict.fromkeys(_HEIGHTS, float))
        camera, ceiling = heights["camera_height"], heights["ceiling_height"]
        if not 0 < camera < ceiling <= _MOST:
            found = f"camera_height={camera}, ceiling_height={ceiling}"
            raise self._wrong(found, "a camera between floor and ceiling")
        vertices = self._points("vertices")
        if len(vertices) < 3 or not _surrounds_origin(vertices):
            found = f"{len(vertices)} vertices that do not surround the camera at (0, 0)"
            raise self._wrong(found, "3 or more around it", "layout_visible")
        fixtures = [
            fixture for kind, label in _FIXTURES.items() for fixture in self._fixtures(kind, label)
        ]
        return Layout(vertices, -camera, ceiling - camera, fixtures)

    def pose(self) -> tuple[PanoramaPose, float]:
        """Return the pose on its floor (height 0), and the camera height in meters.

        Raises:
            DataError: The file does not contain them.
        """
        camera = self._fields({"camera_height": float})["camera_height"]
        kinds = {"rotation": float, "scale": float, "translation": list[float]}
        moved = self._fields(kinds, "floor_plan_transformation")
        lengths = [self.unit_m or math.nan, moved["scale"], camera]
        numbers = [*lengths, moved["rotation"], *moved["translation"]]
        usable = len(numbers) == 6 and all(abs(number) <= _MOST for number in numbers)
        if not usable or min(lengths) <= 0:
            found = f"{moved}, a unit of {self.unit_m} m and camera_height={camera}"
            raise self._wrong(found, "a place on the floor, in meters")
        unit_m = lengths[0] * moved["scale"]
        rotation = rotation_about((0, 0, 1), math.radians(moved["rotation"]))
        location_m = np.array([*moved["translation"], moved["scale"] * camera]) * lengths[0]
        return PanoramaPose(rotation @ _FROM_SPHERE, location_m), unit_m

    def _fixtures(self, kind: str, label: int) -> Iterator[Fixture]:
        points = self._points(kind)
        if len(points) % 3:
            found = f"{len(points)} points for {kind}"
            raise self._wrong(found, "two ends, and [bottom, top], of each", "layout_visible")
        for *ends, (bottom_z, top_z) in points.reshape(-1, 3, 2):
            if not bottom_z < top_z or np.array_equal(*ends):
                found = f"{kind} from {ends[0]} to {ends[1]} with bottom {bottom_z}, top {top_z}"
                raise self._wrong(found, "a bottom below the top", "layout_visible")
            yield Fixture(np.stack(ends), bottom_z, top_z, label)

    def _points(self, kind: str) -> NDArray[np.float64]:
        """Return the points of a list of the layout, ``(n, 2)``."""
        points = self._fields({kind: _POINTS}, "layout_visible")[kind]
        if not all(len(point) == 2 and all(abs(c) <= _MOST for c in point) for point in points):
            raise self._wrong(f"{kind}={points}", "pairs of finite numbers", "layout_visible")
        return np.array(points, np.float64).reshape(-1, 2)

    def _fields(self, kinds: Mapping[str, Any], section: str = "") -> dict[str, Any]:
        """Return fields of the record or of a section, after checking their types."""
        content = self._fields({section: dict})[section] if section else self.record
        return check_fields(self.file, content, kinds, _EXPECTED, self._place(section))

    def _place(self, section: str) -> str:
        return ".".join(("merger", *self.path, *[section] * bool(section)))

    def _wrong(self, found: object, expected: str, section: str = "") -> DataError:
        found = f"{found} in {self._place(section)}"
        return DataError(self.file, found=found, expected=expected, remedy=_COPY)


def list_home_panoramas(root: Path, problems: Problems) -> list[HomePanorama]:
    """List frames with the color image of a panorama, in order.

    Args:
        root: Folder with a folder for every home.
        problems: Collects unreadable files.

    Raises:
        DataError: There are no homes.
    """
    files = sorted(root.glob("*/zind_data.json"))
    if not files:
        raise DataError(
            root,
            found="no */zind_data.json" if root.is_dir() else "no such folder",
            expected="a folder with zind_data.json and panos for every home",
            remedy=_GET_IT,
        )
    found: list[HomePanorama] = []
    for file in files:
        with problems.noted(file.parent.name, file):
            found += _read_home(file)
    return found


def _read_home(file: Path) -> list[HomePanorama]:
    content = read_json(file, _EXPECTED, _COPY)
    kinds = {"merger": dict, "scale_meters_per_coordinate": dict}
    given = check_fields(file, content, kinds, _EXPECTED)
    branches: list[tuple[tuple[str, ...], Any]] = [((), given["merger"])]
    for _ in range(_LEVELS):
        branches = [
            ((*path, name), inner)
            for path, branch in branches
            for name, inner in _named(file, path, branch)
        ]
    units = dict.fromkeys((path[0] for path, _ in branches), float | None)
    place = "scale_meters_per_coordinate"
    unit_m = check_fields(file, given[place], units, _EXPECTED, place)
    panoramas = [(path, dict(_named(file, path, record))) for path, record in branches]
    return [
        # The rest is most of the file, and a thousand homes would fill the memory.
        HomePanorama(file, path, {n: record.get(n) for n in _READ}, unit_m[path[0]])
        for path, record in panoramas
    ]


def _named(file: Path, path: Sequence[str], branch: Any) -> Sequence[tuple[str, Any]]:
    """Return the content of a mapping whose names become parts of file names."""
    if isinstance(branch, Mapping) and all(_NAME.fullmatch(name) for name in branch):
        return list(branch.items())
    place = ".".join(("merger", *path))
    shown = list(branch) if isinstance(branch, Mapping) else type(branch).__name__
    expected = "a mapping, with names of letters, digits and _"
    raise DataError(file, found=f"{shown} in {place}", expected=expected, remedy=_COPY)


def _surrounds_origin(vertices: NDArray[np.float64]) -> bool:
    """True if a polygon goes round the origin once."""
    angles = np.arctan2(vertices[:, 1], vertices[:, 0])
    steps = np.diff(angles, append=angles[:1])
    angles = (steps + np.pi) % (2 * np.pi) - np.pi
    return bool(abs(abs(angles.sum()) - 2 * np.pi) < np.pi / 2)
