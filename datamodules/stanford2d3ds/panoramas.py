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
          semantic/  camera_…_domain_semantic.png    8 bit, see `read_label_table`
        data/                         photos of 1080×1080, rendered from the same scans
          rgb/       camera_<32 hex>_<room>_<n>_frame_<j>_domain_rgb.png             8 bit
          depth/     camera_…_domain_depth.png       16 bit, z-depth in 1/512 m, 65535 = missing
          semantic/  camera_…_domain_semantic.png    8 bit, see `read_label_table`
          pose/      camera_…_domain_pose.json       `camera_k_matrix`, counted from pixel corners

License: free for research, on request: http://buildingparser.stanford.edu/dataset.html
(`2D-3D-Semantics`, the `noXYZ` archives suffice).

Citation: I. Armeni, S. Sax, A. R. Zamir, S. Savarese: "Joint 2D-3D-Semantic Data for Indoor Scene
Understanding", arXiv:1702.01105, 2017.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from datamodules.core.data_module import data_set
from datamodules.core.image_module import ImageDataModule, PhotoDataModule
from datamodules.core.images import ImageFiles
from datamodules.core.label_map import LabelMap
from datamodules.core.panorama_module import PanoramaDataModule
from datamodules.core.splits import Split, draw_groups
from datamodules.stanford2d3ds.files import AREAS, FOLDS, GET_IT, LABEL_MAPS, list_pictures
from datamodules.stanford2d3ds.reader import (
    read_camera_matrix,
    read_depth,
    read_label_table,
    read_panorama_pose,
    read_photo_pose,
)
from tangent_train.errors import DataError, SettingError
from tangent_train.geometry import PanoramaPose


@data_set
class StanfordAreas(ImageDataModule):
    """The three folds of the authors, with rooms for validation.

    Validation uses whole rooms drawn from the training areas, at least one and at most all but one.
    Nothing is selected on the test areas.

    Args:
        fold: 1, 2 or 3, see `FOLDS`.
        areas: Areas to use, all of which must exist; by default all.
        label_table: Path of the class table, if not where the release has it.

    Attributes:
        group: Folder of the images, `pano` or `data`.
    """

    label_maps = LABEL_MAPS
    folds = tuple(FOLDS)
    group: ClassVar[Literal["pano", "data"]]

    fact_settings: ClassVar[tuple[str, ...]] = ("areas",)

    fold: Literal[1, 2, 3] = 1
    areas: Sequence[str] = AREAS
    label_table: Path | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        areas, testing = set(self.areas), set(FOLDS[self.fold])
        if not (areas <= set(AREAS) and testing & areas and areas - testing):
            raise SettingError(
                "data.areas",
                found=list(self.areas),
                expected=f"some of {', '.join(AREAS)}: for testing (fold {self.fold}: "
                f"{', '.join(FOLDS[self.fold])}) and for training (others)",
            )

    def files(self, split: Split) -> list[ImageFiles]:
        """See `DataModule`."""
        return self._splits_of_areas[split]

    @cached_property
    def _splits_of_areas(self) -> dict[Split, list[ImageFiles]]:
        root, areas, problems = self.root, self.areas, self.problems
        if not root.is_dir():
            raise DataError(root, found="no such folder", expected="the data set", remedy=GET_IT)
        there = [area for area in areas if (root / f"area_{area}").is_dir()]
        with problems.noted():
            if len(there) < len(areas):
                raise DataError(
                    root,
                    found="no " + ", ".join(f"area_{area}" for area in areas if area not in there),
                    expected="all of " + ", ".join(f"area_{area}" for area in areas),
                    remedy=GET_IT,
                )
        listed = [
            list_pictures(root, area, self.group, self.reads_depth, problems) for area in there
        ]
        pictures = [picture for pictures in listed for picture in pictures]
        training = [picture for picture in pictures if picture.area not in FOLDS[self.fold]]
        if not self.has_distances:
            _ = self._instances  # refused before anything is decoded
        rooms: set[tuple[str, str, int]] = set()
        if self.val_fraction:
            rooms = draw_groups((p.room for p in training), self.val_fraction, self.seed)
        return {
            "train": [picture.image for picture in training if picture.room not in rooms],
            "val": [picture.image for picture in training if picture.room in rooms],
            "test": [picture.image for picture in pictures if picture.area in FOLDS[self.fold]],
        }

    @cached_property
    def _instances(self) -> LabelMap:
        """Class of every instance, by the class table of the release."""
        places = [self.root / folder / "semantic_labels.json" for folder in ("", "assets")]
        if self.label_table is not None:
            places = [self.label_table]
        table = next((place for place in places if place.is_file()), None)
        if table is None:
            raise DataError(
                places[0],
                found="no class table",
                expected=f"it there or at {places[-1]}",
                remedy="Copy it from the release (assets), or name it in data.label_table.",
            )
        classes: Any = self.label_map
        return read_label_table(table).regrouped(classes)

    def decode_labels(self, files: ImageFiles) -> NDArray[np.uint8]:
        """Return the labels by the class table."""
        path: Any = files.labels
        return self._instances.read_labels(path)

    def decode_depth(self, files: ImageFiles) -> NDArray[np.uint16]:
        """Read depth in steps of 1/512 m, as in the files."""
        path: Any = files.depth
        return read_depth(path)

    def decode_settings(self) -> dict[str, Any]:
        """See `DataModule`."""
        instances = None if self.has_distances else repr(self._instances)
        return {**super().decode_settings(), "instances": instances}

    def pose(self, files: ImageFiles) -> PanoramaPose | None:
        """Read the pose in the pose file; None without a file."""
        pose = files.rgb.name.removesuffix("rgb.png") + "pose.json"
        path = files.rgb.parents[1] / "pose" / pose
        if not path.is_file():
            return None
        return read_panorama_pose(path) if files.camera is None else read_photo_pose(path)


@data_set
class Stanford2D3DS(StanfordAreas, PanoramaDataModule):
    """Stanford2D3DS, 13 classes, in the three folds of its authors."""

    group = "pano"


@data_set
class Stanford2D3DSPerspective(StanfordAreas, PhotoDataModule):
    """The photos of Stanford2D3DS, 13 classes, in the three folds of its authors.

    The validation rooms are those of the panoramas if every room has photos and panoramas.
    """

    group = "data"

    def decode_camera(self, files: ImageFiles) -> NDArray[np.float64]:
        """Read the camera matrix in the pose file."""
        path: Any = files.camera
        return read_camera_matrix(path)
