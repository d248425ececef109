"""Stanford2D3DS (Armeni et al. 2017): six areas of three buildings, 1,413 panoramas, 70,496 photos.

Features: 2048×4096 RGB, depth and 13 semantic classes (`files.CLASSES`), captured with a
Matterport camera; all panoramas are upright. Three folds by area, defined by the authors.

On disk, as released::

    root/
      semantic_labels.json            (or assets/semantic_labels.json)
      area_1/ area_2/ area_3/ area_4/ area_5a/ area_5b/ area_6/
        pano/
          rgb/       camera_<32 hex>_<room>_<n>_frame_equirectangular_domain_rgb.png       8 bit
          depth/     camera_…_domain_depth.png       16 bit, 1/512 m, 65535 = missing
          semantic/  camera_…_domain_semantic.png    8 bit, see `LabelTable`
        data/                         photos of 1080×1080, rendered from the same scans
          rgb/       camera_<32 hex>_<room>_<n>_frame_<j>_domain_rgb.png             8 bit
          depth/     camera_…_domain_depth.png       16 bit, z-depth in 1/512 m, 65535 = missing
          semantic/  camera_…_domain_semantic.png    8 bit, see `LabelTable`
          pose/      camera_…_domain_pose.json       `camera_k_matrix`, counted from pixel corners

License: free for research, on request: http://buildingparser.stanford.edu/dataset.html
(`2D-3D-Semantics`, the `noXYZ` archives suffice).

Citation: I. Armeni, S. Sax, A. R. Zamir, S. Savarese: "Joint 2D-3D-Semantic Data for Indoor Scene
Understanding", arXiv:1702.01105, 2017.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from datamodules.core.data_module import data_set
from datamodules.core.image_module import ImageDataModule, PhotoDataModule
from datamodules.core.images import STEPS_PER_M, ImageFiles, meters_to_steps
from datamodules.core.label_map import LabelMap
from datamodules.core.panorama_module import PanoramaDataModule
from datamodules.core.problems import Problems
from datamodules.core.splits import Split, draw_groups
from datamodules.stanford2d3ds.files import (
    AREAS,
    CLASSES,
    EIGHT,
    FOLDS,
    UNKNOWN_CLASS,
)
from datamodules.synthrooms.camera import CAMERA_FROM_SPHERE, euler_rotation
from tangent_train.errors import DataError, SettingError
from tangent_train.files import read_json
from tangent_train.geometry import PanoramaPose
from tangent_train.io.pixel_files import read_depth_m

GET_IT = (
    "Get Stanford2D3DS from http://buildingparser.stanford.edu/dataset.html and point data.root at "
    "the folder with area_1 … area_6, or train on data=synthrooms, which needs no download."
)
"""Remedy if the data set is missing."""

_NAME = re.compile(
    r"camera_([0-9a-f]{32})_([A-Za-z]+)_(\d+)_frame_(equirectangular|\d+)_domain_rgb\.png"
)
_CENTERS_FROM_CORNERS = np.array([[1, 0, -0.5], [0, 1, -0.5], [0, 0, 1]])
_THIRTEEN = LabelMap.of(CLASSES)


class PictureFiles(NamedTuple):
    """One panorama (`pano`) or photo (`data`).

    Attributes:
        area: One of `AREAS`.
        room: Building, kind and number of the room; 5a and 5b are one building.
        camera: 32 hexadecimal digits.
        image: Files of the image, named ``area_3/office_2/<32 hex>``; for photos, ``…/<frame>``.
    """

    area: str
    room: tuple[str, str, int]
    camera: str
    image: ImageFiles


def list_pictures(
    root: Path, area: str, group: Literal["pano", "data"], with_depth: bool, problems: Problems
) -> list[PictureFiles]:
    """List the panoramas or photos of an area in the order of their names.

    Args:
        root: Folder of the data set.
        area: One of `AREAS`.
        group: Panoramas or photos.
        with_depth: True to list depth files too.
        problems: Collects problems: no images, or unknown files.
    """
    folder = root / f"area_{area}" / group
    found = []
    # Hidden files are leftovers of archives made on a Mac.
    images = sorted((folder / "rgb").glob("[!.]*.png"))
    with problems.noted():
        if not images:
            expected = "camera_….png files"
            raise DataError(folder / "rgb", found="no images", expected=expected, remedy=GET_IT)
    for rgb in images:
        with problems.noted(str(rgb), rgb):
            name = _NAME.fullmatch(rgb.name)
            if name is None:
                expected = "camera_<32 hex>_<room>_<n>_frame_<frame>_domain_rgb.png"
                raise DataError(rgb, found="an unknown file name", expected=expected)
            camera, kind, number, frame = name.groups()
            semantic, depth, pose = (
                folder / end.partition(".")[0] / (rgb.name.removesuffix("rgb.png") + end)
                for end in ("semantic.png", "depth.png", "pose.json")
            )
            is_photo = group == "data"
            title = f"area_{area}/{kind}_{number}/{camera}" + (f"/{frame}" if is_photo else "")
            image = ImageFiles(
                title, rgb, semantic, depth if with_depth else None, pose if is_photo else None
            )
            room = area.rstrip("ab"), kind, int(number)
            found.append(PictureFiles(area, room, camera, image))
    return found


def read_label_table(path: Path) -> LabelMap:
    """Read `semantic_labels.json`, a list of names ``class_instance_room_number_area``.

    A pixel of a `semantic` image holds the index of an instance as the color
    R · 65536 + G · 256 + B. Missing labels are #0D0D0D = 855309, past the end of the table.
    (Without R they would be instance 3341, clutter.) All past the end is unknown.

    Raises:
        DataError: The file cannot be read or is not such a list.
    """
    expected = "semantic_labels.json of the release: a list of names"
    labels = {UNKNOWN_CLASS: 0} | {name: i for i, name in enumerate(CLASSES, start=1)}
    classes = [name.partition("_")[0] for name in read_json(path, expected, kind=list[str])]
    if strange := sorted(set(classes) - set(labels)):
        raise DataError(path, found=f"class {strange[0]!r}", expected=expected)
    colors: dict[int | str, int] = {
        f"#{instance:06x}": labels[name] for instance, name in enumerate(classes)
    }
    return LabelMap(CLASSES, colors, refuses_others=False)


@data_set
class StanfordImages(ImageDataModule):
    """The three folds of the authors, with rooms for validation.

    Validation uses whole rooms drawn from the training areas, at least one and at most all but one.
    Nothing is selected on the test areas.

    Args:
        fold: See `FOLDS`.
        areas: Areas to use, all of which must exist; by default all.
        label_table: Path of the class table, if not where the release has it.

    Attributes:
        group: Folder of the images, `pano` or `data`.
    """

    label_maps: ClassVar[Mapping[str, LabelMap]] = {
        "13": _THIRTEEN,
        "8": _THIRTEEN.regrouped(LabelMap.grouped(EIGHT)),
    }
    group: ClassVar[Literal["pano", "data"]]
    fact_settings: ClassVar[tuple[str, ...]] = ("areas",)
    folds: ClassVar[tuple[int, ...]] = tuple(FOLDS)

    fold: Literal[1, 2, 3] = 1
    areas: Sequence[Literal["1", "2", "3", "4", "5a", "5b", "6"]] = AREAS  # type: ignore[assignment]
    label_table: Path | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        areas, testing = set(self.areas), set(FOLDS[self.fold])
        if not (testing & areas and areas - testing):
            expected = f"some for testing ({', '.join(FOLDS[self.fold])}) and some for training"
            raise SettingError("data.areas", found=list(self.areas), expected=expected)

    def files(self, split: Split) -> Sequence[ImageFiles]:
        """See `DataModule`."""
        return self._divided[split]

    @cached_property
    def _divided(self) -> dict[Split, list[ImageFiles]]:
        pictures = [
            picture
            for area in self.areas
            for picture in list_pictures(
                self.root, area, self.group, self.reads_depth, self.problems
            )
        ]
        training = [picture for picture in pictures if picture.area not in FOLDS[self.fold]]
        rooms: set[tuple[str, str, int]] = set()
        if self.val_fraction:
            rooms = draw_groups((p.room for p in training), self.val_fraction, self.seed)
        return {
            "train": [picture.image for picture in training if picture.room not in rooms],
            "val": [picture.image for picture in training if picture.room in rooms],
            "test": [picture.image for picture in pictures if picture.area in FOLDS[self.fold]],
        }

    @cached_property
    def _label_table(self) -> LabelMap:
        """Label of the color of every instance."""
        label_map: Any = self.label_map
        places = [self.root / folder / "semantic_labels.json" for folder in ("", "assets")]
        path = self.label_table or next(filter(Path.is_file, places), places[0])
        return read_label_table(path).regrouped(LabelMap.grouped(label_map.names))

    def decode_labels(self, files: ImageFiles) -> NDArray[np.uint8]:
        """See `ImageDataModule`: by the class table."""
        path: Any = files.labels
        return self._label_table.read_labels(path)

    def decode_depth(self, files: ImageFiles) -> NDArray[np.uint16]:
        """See `ImageDataModule`."""
        path: Any = files.depth
        return read_depth(path)

    def pose(self, files: ImageFiles) -> PanoramaPose | None:
        """See `ImageDataModule`: by the pose file, if there is one."""
        path = pose_file(files)
        if not path.is_file():
            return None
        return read_panorama_pose(path) if files.camera is None else read_photo_pose(path)

    def decode_settings(self) -> dict[str, Any]:
        """See `DataModule`."""
        table = "" if self.has_distances else str(self._label_table.labels)
        return {**super().decode_settings(), "class table": table}


@data_set
class Stanford2D3DS(StanfordImages, PanoramaDataModule):
    """Stanford2D3DS, 13 or 8 classes, in the three folds of its authors."""

    group = "pano"


@data_set
class Stanford2D3DSPerspective(StanfordImages, PhotoDataModule):
    """The photos of Stanford2D3DS, 13 or 8 classes, in the three folds of its authors.

    The validation rooms are those of the panoramas if every room has photos and panoramas.
    """

    group = "data"

    def decode_camera(self, files: ImageFiles) -> NDArray[np.float64]:
        """See `ImageDataModule`: by the pose file."""
        return read_camera_matrix(pose_file(files))


def pose_file(files: ImageFiles) -> Path:
    """Return the pose file of an image."""
    name = files.rgb.name.removesuffix("rgb.png") + "pose.json"
    return files.rgb.parents[1] / "pose" / name


def read_depth(path: Path) -> NDArray[np.uint16]:
    """Read depth in steps of 1/512 m, 0 where missing.

    Raises:
        DataError: The file is broken, or holds no depth.
    """
    return meters_to_steps(read_depth_m(path, STEPS_PER_M))


class _PoseRecord(BaseModel):
    """Numbers of a pose file; some releases have a fourth row 0 0 0 1."""

    model_config = ConfigDict(allow_inf_nan=False)

    camera_k_matrix: list[tuple[float, float, float]] = Field(min_length=3, max_length=3)
    camera_rt_matrix: list[tuple[float, float, float, float]] = Field(min_length=3, max_length=4)
    camera_original_rotation: tuple[float, float, float]
    camera_location: tuple[float, float, float]


def _read_pose_file(path: Path) -> _PoseRecord:
    record: _PoseRecord = read_json(path, "a pose file of the release", kind=_PoseRecord)
    return record


def read_camera_matrix(path: Path) -> NDArray[np.float64]:
    """Read the camera matrix of a pose file.

    Args:
        path: ``camera_…_domain_pose.json``.

    Returns:
        ``(3, 3)`` K for integer pixel centers (the file counts from pixel corners).

    Raises:
        DataError: The file is missing or broken.
    """
    matrix: NDArray[np.float64] = np.array(_read_pose_file(path).camera_k_matrix)
    return _CENTERS_FROM_CORNERS @ matrix


def read_panorama_pose(path: Path) -> PanoramaPose:
    """Read the pose file of a panorama.

    Args:
        path: ``…_domain_pose.json``.

    Raises:
        DataError: It cannot be read.
    """
    record = _read_pose_file(path)
    angles = np.array(record.camera_original_rotation)
    if np.abs(angles).max() > 2 * math.pi:
        angles = np.radians(angles)
    original = euler_rotation(angles)
    rotation = np.array(record.camera_rt_matrix)[:3, :3]
    world_from_panorama = original @ rotation @ original @ CAMERA_FROM_SPHERE
    return _checked_pose(path, world_from_panorama, np.array(record.camera_location))


def read_photo_pose(path: Path) -> PanoramaPose:
    """Read the pose of a photo, in the axes of `LabeledImage`.

    The camera matrix [R | t] of the file takes points of the world to the camera: x right, y down,
    z forward. This was tested with SynthRooms.

    Args:
        path: ``camera_…_domain_pose.json``.

    Raises:
        DataError: It cannot be read.
    """
    rt = np.array(_read_pose_file(path).camera_rt_matrix)
    world_from_camera = rt[:3, :3].T
    location_m = -world_from_camera @ rt[:3, 3]
    return _checked_pose(path, world_from_camera @ CAMERA_FROM_SPHERE, location_m)


def _checked_pose(
    path: Path, world_from_panorama: NDArray[np.float64], location_m: NDArray[np.float64]
) -> PanoramaPose:
    try:
        return PanoramaPose(world_from_panorama, location_m)
    except SettingError as error:
        raise DataError(path, found=error.found, expected="a rotation") from error
