"""Pairs of Stanford2D3DS's panoramas: the paper's sixty of area 1, or all of the same rooms.

``pairs.csv`` holds the paper's tables of pairs and of single results as they are printed:
number, split, images, overlap of the fields of view, then PMR, MS and P on the equirectangular
image and at base levels 0, 1 and 2. What does not fit together in print is left so: the means of
the overlaps are 0.896 (easy) and 0.836 (hard) where the paper's text has 89.35 % and 83.35 %, and
the mean PMR of the hard pairs at level 0 is 28.7 % where its table has 28.4 %. Pairs 17 and 22 are
hard with the overlap, 0.86, that six easy ones have: the split is by figures before rounding.
"""

from __future__ import annotations

import csv
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np

from datamodules.core.panorama_pairs import PairedPanorama, PanoramaPair, PanoramaPairs
from datamodules.core.panoramas import resize_area, resize_depth, steps_to_meters
from datamodules.images.png import check_panorama_size, check_png, read_color_png, read_depth_png
from datamodules.stanford2d3ds.files import (
    AREAS,
    GET_IT,
    MISSING_DEPTH,
    PictureFiles,
    list_pictures,
)
from datamodules.stanford2d3ds.poses import read_panorama_pose
from tangent_train.errors import DataError, SettingError

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import NDArray

__all__ = ["PUBLISHED_REPRESENTATIONS", "PublishedPair", "StanfordPairs", "published_pairs"]

PUBLISHED_REPRESENTATIONS = ("ERP", "L0", "L1", "L2")
"""What the paper detects keypoints on."""

_AREA = "1"
_SHORT = 7  # hexadecimal digits of a camera that the paper prints
_Chosen = tuple[str, str | None, PictureFiles, PictureFiles]


class PublishedPair(NamedTuple):
    """A pair of the paper, and what the paper reports of it.

    Attributes:
        number: 0 to 59.
        split: ``easy`` or ``hard``.
        left: Camera, abbreviated, and room: ``0f65e09_hallway_7``.
        right: The same.
        fov_overlap: Overlap of the fields of view, 0 to 1.
        scores: PMR, MS and P, shares, of each of `PUBLISHED_REPRESENTATIONS`.
    """

    number: int
    split: str
    left: str
    right: str
    fov_overlap: float
    scores: dict[str, tuple[float, float, float]]


def published_pairs() -> list[PublishedPair]:
    """The paper's pairs, in the order of their numbers."""
    path = Path(__file__).with_suffix(".csv")
    with path.open(encoding="utf-8", newline="") as file:
        rows = list(csv.reader(file))[1:]
    pairs = []
    for number, split, left, right, overlap, *printed in rows:
        figures = list(map(float, printed))
        scores = {
            name: (figures[3 * k], figures[3 * k + 1], figures[3 * k + 2])
            for k, name in enumerate(PUBLISHED_REPRESENTATIONS)
        }
        pairs.append(PublishedPair(int(number), split, left, right, float(overlap), scores))
    return pairs


class StanfordPairs(PanoramaPairs):
    """Pairs of Stanford2D3DS's panoramas with depth and pose; see `stanford2d3ds.poses`.

    Args:
        root: Folder with ``area_1`` …, of which ``pano/rgb``, ``pano/depth`` and ``pano/pose`` are
            read.
        pairs: `paper`, the sixty of area 1; or `rooms`, any two panoramas of the same room.
        areas: Where to look with `rooms`; by default all areas that are there.
        erp_height: Rows to shrink the panoramas to; by default they stay as they are.

    Raises:
        SettingError: A setting that cannot work.
    """

    def __init__(
        self,
        root: str | Path,
        pairs: Literal["paper", "rooms"] = "paper",
        areas: Sequence[str] | None = None,
        erp_height: int | None = None,
    ) -> None:
        if pairs not in ("paper", "rooms"):
            raise SettingError("data.pairs", found=pairs, expected="paper or rooms")
        if areas is not None and (pairs == "paper" or not set(areas) <= set(AREAS)):
            expected = (
                f"some of {', '.join(AREAS)}" if pairs == "rooms" else "none with pairs=paper"
            )
            raise SettingError("data.areas", found=list(areas), expected=expected)
        if erp_height is not None and (type(erp_height) is not int or erp_height < 1):
            raise SettingError("data.erp_height", found=erp_height, expected="rows, or null")
        self.root = Path(root).expanduser()
        self._pairs = pairs
        self._areas = areas
        self._height = erp_height
        self._found: list[_Chosen] | None = None

    @property
    def is_published(self) -> bool:
        """Whether these are the paper's pairs, so that its figures can stand beside others."""
        return self._pairs == "paper"

    def __len__(self) -> int:
        """See `PanoramaPairs`."""
        return len(self._chosen)

    def name(self, index: int) -> str:
        """The paper's number of a pair, or its room and the beginnings of its cameras."""
        return self._chosen[index][0]

    def read(self, index: int) -> PanoramaPair:
        """Read a pair; see `PanoramaPairs`."""
        name, split, *sides = self._chosen[index]
        left, right = map(self._read, sides)
        return PanoramaPair(name, split, left, right)

    @property
    def _chosen(self) -> list[_Chosen]:
        if self._found is None:
            self._found = self._of_paper() if self._pairs == "paper" else self._of_rooms()
        return self._found

    def _of_paper(self) -> list[_Chosen]:
        files = self._list([_AREA])
        pairs = published_pairs()
        found = _resolve({name for pair in pairs for name in (pair.left, pair.right)}, files)
        return [(str(p.number), p.split, found[p.left], found[p.right]) for p in pairs]

    def _of_rooms(self) -> list[_Chosen]:
        areas = self._areas
        if areas is None:
            areas = [area for area in AREAS if (self.root / f"area_{area}").is_dir()]
        files = self._list(areas)
        pairs: list[_Chosen] = [
            (f"{one.area}_{_short(one)}_{other.name.camera[:_SHORT]}", None, one, other)
            for one, other in combinations(files, 2)
            if one.room == other.room
        ]
        if not pairs:
            raise DataError(
                self.root, found="no two panoramas of one room", expected="pairs", remedy=GET_IT
            )
        return pairs

    def _list(self, areas: Iterable[str]) -> list[PictureFiles]:
        areas = list(areas)
        if not areas:
            raise DataError(self.root, found="no area", expected="area_1 and so on", remedy=GET_IT)
        return [f for area in areas for f in list_pictures(self.root, area, "pano", True)]

    def _read(self, files: PictureFiles) -> PairedPanorama:
        size = check_png(files.rgb, 8, ("RGB", "RGBA"))[:2]
        check_panorama_size(files.rgb, size, self._height or 1)
        if files.depth is None:
            raise DataError(files.rgb, found="no depth", expected="depth of the panorama")
        depth_size = check_png(files.depth, 16, ("grey",))[:2]
        if depth_size != size:
            raise DataError(
                files.depth,
                found=f"{depth_size[0]}×{depth_size[1]} pixels",
                expected=f"{size[0]}×{size[1]}, as {files.rgb.name}",
                remedy="Copy or extract both files again.",
            )
        shape = size if self._height is None else (self._height, 2 * self._height)
        rgb = resize_area(read_color_png(files.rgb), shape)
        distance = _distance_m(files.depth, shape)
        pose = read_panorama_pose(files.pose)
        return PairedPanorama(files.short_name, rgb, distance, pose, files.rgb)


def _short(files: PictureFiles) -> str:
    return f"{files.name.room}_{files.name.room_number}_{files.name.camera[:_SHORT]}"


def _distance_m(path: Path, shape: tuple[int, int]) -> NDArray[np.float32]:
    steps = read_depth_png(path)
    steps[steps == MISSING_DEPTH] = 0
    steps = resize_depth(steps, shape)
    distance = steps_to_meters(steps)
    distance[steps == 0] = np.nan
    return distance


def _resolve(names: Iterable[str], files: Sequence[PictureFiles]) -> dict[str, PictureFiles]:
    """The files of abbreviated names, ``<beginning of the camera>_<room>_<number>``.

    Raises:
        DataError: Some names fit no panorama, or several; all are told at once.
    """
    found: dict[str, PictureFiles] = {}
    missing: list[str] = []
    ambiguous: list[str] = []
    for name in sorted(names):
        camera, _, room = name.partition("_")
        fitting = [
            picture
            for picture in files
            if picture.name.camera.startswith(camera)
            and f"{picture.name.room}_{picture.name.room_number}" == room
        ]
        if len(fitting) == 1:
            found[name] = fitting[0]
        else:
            (ambiguous if fitting else missing).append(name)
    if missing or ambiguous:
        kinds = (("not there: ", missing), ("fits several: ", ambiguous))
        folder = files[0].rgb.parent
        raise DataError(
            folder,
            found="; ".join(kind + ", ".join(which) for kind, which in kinds if which),
            expected="one panorama for each image of the paper's pairs",
            remedy="Copy or extract area_1 again; data.pairs=rooms takes what is there.",
        )
    return found
