"""Files of Stanford2D3DS: names, classes and folds."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Literal, NamedTuple

from datamodules.core.label_map import LabelMap
from datamodules.core.problems import Problems
from tangent_train.errors import DataError

if TYPE_CHECKING:  # slow to import; SynthRooms needs only the names
    from datamodules.core.images import ImageFiles


AREAS: tuple[str, ...] = ("1", "2", "3", "4", "5a", "5b", "6")
"""All areas; 5a and 5b are parts of one floor and share rooms."""

CLASSES: tuple[str, ...] = (
    "beam",
    "board",
    "bookcase",
    "ceiling",
    "chair",
    "clutter",
    "column",
    "door",
    "floor",
    "sofa",
    "table",
    "wall",
    "window",
)
"""The 13 classes; the label of a class is its index plus one."""

EIGHT: tuple[str, ...] = (
    *("ceiling", "chair", "door", "floor", "sofa", "table", "wall", "window"),
)
"""The classes of the adaptation benchmarks SPin8, SPan8 and S3D8."""

LABEL_MAPS = {"13": LabelMap.grouped(CLASSES), "8": LabelMap.grouped(EIGHT)}
"""Values of the setting `classes`, by names of classes."""

UNKNOWN_CLASS = "<UNK>"
"""Class of unlabeled instances."""

MISSING_LABEL = 0x0D0D0D
"""Instance of pixels without a label."""

MISSING_DEPTH = 65535
"""Depth of pixels without depth."""

FOLDS: dict[int, tuple[str, ...]] = {1: ("5a", "5b"), 2: ("2", "4"), 3: ("1", "3", "6")}
"""Test areas of each fold; the other areas are for training."""

GET_IT = (
    "Get Stanford2D3DS from http://buildingparser.stanford.edu/dataset.html and point data.root at "
    "the folder with area_1 … area_6, or train on data=synthrooms, which needs no download."
)
"""Remedy if the data set is missing."""

_NAME = re.compile(
    r"camera_([0-9a-f]{32})_([A-Za-z]+)_(\d+)_frame_(equirectangular|\d+)_domain_rgb\.png"
)


class FileName(NamedTuple):
    """Parts of the name of an image; panoramas have the frame `equirectangular`."""

    camera: str
    room: str
    room_number: int
    frame: str

    @classmethod
    def parse(cls, name: str) -> FileName:
        """Parse a file name.

        Args:
            name: Name without folders.

        Raises:
            DataError: The name does not follow the data set.

        >>> FileName.parse(f"camera_{'0f' * 16}_office_7_frame_3_domain_rgb.png")[1:]
        ('office', 7, '3')
        """
        match = _NAME.fullmatch(name)
        if match is None:
            raise DataError(
                name,
                found="an unknown file name",
                expected="camera_<32 hex>_<room>_<n>_frame_<equirectangular or number>"
                "_domain_rgb.png",
                remedy="Move files that do not belong to the data set elsewhere.",
            )
        camera, room, number, frame = match.groups()
        return cls(camera, room, int(number), frame)


class PictureFiles(NamedTuple):
    """One panorama (`pano`) or photo (`data`).

    Attributes:
        area: One of `AREAS`.
        name: Parts of the file name.
        image: Files of the image, named ``area_3/office_2/<32 hex>``; for photos, ``…/<frame>``.
        pose: File of camera and pose.
    """

    area: str
    name: FileName
    image: ImageFiles
    pose: Path

    @property
    def room(self) -> tuple[str, str, int]:
        """Building, kind and number of the room; 5a and 5b are one building."""
        return self.area.rstrip("ab"), self.name.room, self.name.room_number


def list_pictures(
    root: Path,
    area: str,
    group: Literal["pano", "data"],
    with_depth: bool,
    problems: Problems,
) -> list[PictureFiles]:
    """List the panoramas or photos of an area in the order of their names.

    Args:
        root: Folder of the data set.
        area: One of `AREAS`.
        group: Panoramas or photos.
        with_depth: True to list depth files too.
        problems: Collects problems: no images, or unknown files.
    """
    from datamodules.core.images import ImageFiles

    folder = root / f"area_{area}" / group
    found = []
    # Hidden files are leftovers of archives made on a Mac.
    images = sorted((folder / "rgb").glob("[!.]*.png"))
    with problems.noted():
        if not images:
            none = "no panoramas" if group == "pano" else "no photos"
            expected = "camera_….png files"
            raise DataError(folder / "rgb", found=none, expected=expected, remedy=GET_IT)
    for rgb in images:
        with problems.noted(str(rgb), rgb):
            name = FileName.parse(rgb.name)
            semantic, depth, pose = (
                folder / kind.partition(".")[0] / (rgb.name.removesuffix("rgb.png") + kind)
                for kind in ("semantic.png", "depth.png", "pose.json")
            )
            title, camera = f"area_{area}/{name.room}_{name.room_number}/{name.camera}", None
            if group == "data":
                title, camera = f"{title}/{name.frame}", pose
            image = ImageFiles(title, rgb, semantic, depth if with_depth else None, camera)
            found.append(PictureFiles(area, name, image, pose))
    return found
