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
from typing import Any, ClassVar, Literal, cast

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field
from scipy.spatial.transform import Rotation

from datamodules.core.data_module import data_set
from datamodules.core.dataset import Labels
from datamodules.core.files import ImageFiles, Problems, Split, draw_groups
from datamodules.core.image_module import ImageDataModule, PanoramaDataModule, PhotoDataModule
from datamodules.core.inputs import Input
from datamodules.core.label_map import PANOPTIC, LabelMap
from datamodules.stanford2d3ds import files as stanford
from tangent_train.errors import DataError
from tangent_train.files import read_json
from tangent_train.geometry import PanoramaPose
from tangent_train.io.image_files import glob_files
from tangent_train.io.pixel_files import read_rgb

GET_IT = "Get Stanford2D3DS from http://buildingparser.stanford.edu, or choose data=synthrooms."
"""Remedy if the data set is missing."""

_NAME = re.compile(
    r"camera_([0-9a-f]{32})_([A-Za-z]+_\d+)_frame_(equirectangular|\d+)_domain_rgb\.png"
)
_CENTERS_FROM_CORNERS = np.array([[1, 0, -0.5], [0, 1, -0.5], [0, 0, 1]])
_THIRTEEN = LabelMap.of(stanford.CLASSES)


def list_pictures(
    root: Path, area: str, group: Literal["pano", "data"], with_depth: bool, problems: Problems
) -> list[ImageFiles]:
    """List the panoramas or photos of an area in the order of their names.

    Args:
        root: Folder of the data set.
        area: One of `AREAS`.
        group: Panoramas or photos.
        with_depth: True to list depth files too.
        problems: Collects problems: no images, or unknown files.

    Returns:
        Images named ``area_3/office_2/<32 hex>``; photos, ``…/<frame>``.
    """
    folder, found = root / f"area_{area}" / group, []
    images = glob_files(folder / "rgb", "*.png")
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
            camera, room, frame = name.groups()
            is_photo = group == "data"
            files = ImageFiles(
                f"area_{area}/{room}/{camera}" + (f"/{frame}" if is_photo else ""),
                rgb,
                sibling(rgb, "semantic.png"),
                sibling(rgb, "depth.png") if with_depth else None,
                sibling(rgb, "pose.json") if is_photo else None,
            )
            found.append(files)
    return found


def sibling(rgb: Path, end: str) -> Path:
    """Return another file of an image, e.g. its ``pose.json``."""
    name = rgb.name.removesuffix("rgb.png") + end
    return rgb.parents[1] / end.partition(".")[0] / name


def room_of(files: ImageFiles) -> tuple[str, str, int]:
    """Return building, kind and number of a room; 5a and 5b are one building."""
    area, room, *_ = files.name.removeprefix("area_").split("/")
    kind, _, number = room.rpartition("_")
    return area.rstrip("ab"), kind, int(number)


def read_label_table(path: Path) -> LabelMap:
    """Read `semantic_labels.json`, a list of names ``class_instance_room_number_area``.

    A pixel of a `semantic` image holds the index of an instance as the color
    R · 65536 + G · 256 + B. Missing labels are #0D0D0D = 855309, past the end of the table.
    (Without R they would be instance 3341, clutter.) All past the end is unknown.

    Raises:
        DataError: The file cannot be read or is not such a list.
    """
    labels = {stanford.UNKNOWN_CLASS: 0} | {
        name: i for i, name in enumerate(stanford.CLASSES, start=1)
    }
    instances = read_json(path, "semantic_labels.json of the release", kind=list[str])
    colors: dict[int | str, int] = {
        f"#{k:06x}": labels[name.partition("_")[0]] for k, name in enumerate(instances)
    }
    return LabelMap(stanford.CLASSES, colors, refuses_others=False)


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
        "8": _THIRTEEN.regrouped(stanford.EIGHT),
    }
    group: ClassVar[Literal["pano", "data"]]
    get_it = GET_IT
    fact_settings: ClassVar[tuple[str, ...]] = ("areas",)
    cache_settings: ClassVar[tuple[str, ...]] = ("_label_table",)
    folds: ClassVar[tuple[int, ...]] = tuple(stanford.FOLDS)

    inputs: Sequence[Input] = ("rgb", "depth")
    fold: Literal[1, 2, 3] = 1
    areas: Sequence[stanford.Area] = stanford.AREAS
    label_table: Path | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        testing = set(self.areas) & set(stanford.FOLDS[self.fold])
        expected = (
            f"some for testing ({', '.join(stanford.FOLDS[self.fold])}) and some for training"
        )
        self.refuse("areas", not testing or testing == set(self.areas), expected)

    def files(self) -> Mapping[Split, Sequence[ImageFiles]]:
        """See `DataModule`."""
        training: list[ImageFiles] = []
        test: list[ImageFiles] = []
        for area in self.areas:
            part = test if area in stanford.FOLDS[self.fold] else training
            part += list_pictures(self.root, area, self.group, self.reads_depth, self.problems)
        rooms = draw_groups(map(room_of, training), self.val_fraction, self.seed)
        val = [files for files in training if room_of(files) in rooms]
        train = [files for files in training if room_of(files) not in rooms]
        return {"train": train, "val": val, "test": test}

    @cached_property
    def _label_table(self) -> LabelMap | None:
        """Label of the color of every instance; None if the labels are distances."""
        if self.label_map is None:
            return None
        places = [self.root / folder / "semantic_labels.json" for folder in ("", "assets")]
        path = self.label_table or next(filter(Path.is_file, places), places[0])
        return read_label_table(path).regrouped(self.label_map.names)

    def decode_labels(self, files: ImageFiles) -> Labels:
        """See `ImageDataModule`: by the class table.

        The number of an object is its index in the table, without the upper byte.
        """
        table, path = cast("LabelMap", self._label_table), cast("Path", files.labels)
        colors = read_rgb(path, as_stored=True)
        labels = table.decode(colors, path)
        if self.labels != PANOPTIC:
            return labels
        return self.panoptic_map(labels, colors[..., 1:] @ np.array([256, 1], np.int32))

    def pose(self, files: ImageFiles) -> PanoramaPose | None:
        """See `ImageDataModule`: by the pose file, if there is one."""
        path = sibling(files.rgb, "pose.json")
        if not path.is_file():
            return None
        return read_panorama_pose(path) if files.camera is None else read_photo_pose(path)


@data_set
class Stanford2D3DS(StanfordImages, PanoramaDataModule):
    """Stanford2D3DS, 13 or 8 classes, in the three folds of its authors."""

    things = stanford.THINGS
    group = "pano"


@data_set
class Stanford2D3DSPerspective(StanfordImages, PhotoDataModule):
    """The photos of Stanford2D3DS, 13 or 8 classes, in the three folds of its authors.

    The validation rooms are those of the panoramas if every room has photos and panoramas.
    """

    group = "data"

    def decode_camera(self, files: ImageFiles) -> NDArray[np.float64]:
        """See `ImageDataModule`: by the pose file."""
        matrix: NDArray[np.float64] = np.array(_read_pose_file(files.camera).camera_k_matrix)
        return _CENTERS_FROM_CORNERS @ matrix


class _PoseRecord(BaseModel):
    """Numbers of a pose file; some releases have a fourth row 0 0 0 1."""

    model_config = ConfigDict(allow_inf_nan=False)

    camera_k_matrix: list[tuple[float, float, float]] = Field(min_length=3, max_length=3)
    camera_rt_matrix: list[tuple[float, float, float, float]] = Field(min_length=3, max_length=4)
    camera_original_rotation: tuple[float, float, float]
    camera_location: tuple[float, float, float]


def _read_pose_file(path: Any) -> _PoseRecord:
    record: _PoseRecord = read_json(path, "a pose file of the release", kind=_PoseRecord)
    return record


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
    original = Rotation.from_euler("xyz", angles).as_matrix()
    rotation = np.array(record.camera_rt_matrix)[:3, :3]
    world_from_panorama = original @ rotation @ original @ stanford.CAMERA_FROM_SPHERE
    return PanoramaPose(world_from_panorama, record.camera_location)


def read_photo_pose(path: Path) -> PanoramaPose:
    """Read the pose of a photo, in the axes of `ImageDataModule.pose`.

    The camera matrix [R | t] of the file takes points of the world to the camera: x right, y down,
    z forward. This was tested with SynthRooms.

    Args:
        path: ``camera_…_domain_pose.json``.

    Raises:
        DataError: It cannot be read.
    """
    rt = np.array(_read_pose_file(path).camera_rt_matrix)
    world_from_camera = rt[:3, :3].T
    return PanoramaPose(
        world_from_camera @ stanford.CAMERA_FROM_SPHERE, -world_from_camera @ rt[:3, 3]
    )
