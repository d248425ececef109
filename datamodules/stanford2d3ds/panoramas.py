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

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Literal

import numpy as np

from datamodules.core.image_module import ImageDataModule, PanoramaDataModule, PhotoDataModule
from datamodules.core.splits import Split, draw_groups
from datamodules.core.images import ImageFiles
from datamodules.core.problems import Problems
from datamodules.stanford2d3ds.files import AREAS, CLASS_SETS, CLASSES, FOLDS, GET_IT, list_pictures
from datamodules.stanford2d3ds.reader import LabelTable, StanfordReader
from tangent_train.errors import DataError


@dataclass(kw_only=True, eq=False, repr=False)
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

    Raises:
        SettingError: A setting is invalid.
    """

    class_names = ("unknown", *CLASSES)
    class_sets = CLASS_SETS
    group: ClassVar[Literal["pano", "data"]]

    fact_settings: ClassVar[tuple[str, ...]] = ("areas",)

    fold: int = 1
    areas: Sequence[str] = AREAS
    label_table: Path | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        self.label_table = None if self.label_table is None else Path(self.label_table)
        fine = self.label_table is None or not self.has_distances
        self.require("label_table", fine, "null: distances have no classes")
        self.require("fold", self.fold in FOLDS, "1, 2 or 3")
        areas, testing = set(self.areas), set(FOLDS[self.fold])
        self.require(
            "areas",
            areas <= set(AREAS) and bool(testing & areas) and bool(areas - testing),
            f"some of {', '.join(AREAS)}: for testing (fold {self.fold}: "
            f"{', '.join(FOLDS[self.fold])}) and for training (others)",
        )

    def find_images(
        self, problems: Problems
    ) -> tuple[StanfordReader, dict[Split, list[ImageFiles]]]:
        """See `ImageDataModule`."""
        root, areas = self.root, self.areas
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
        rooms: set[tuple[str, str, int]] = set()
        if self.val_fraction:
            rooms = draw_groups((p.room for p in training), self.val_fraction, self.seed)
        return self._reader(), {
            "train": [picture.image for picture in training if picture.room not in rooms],
            "val": [picture.image for picture in training if picture.room in rooms],
            "test": [picture.image for picture in pictures if picture.area in FOLDS[self.fold]],
        }

    def _reader(self) -> StanfordReader:
        """Return the reader, with the class table if the labels are classes."""
        if self.has_distances:
            return StanfordReader(LabelTable(np.empty(0, np.uint8)))
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
        return StanfordReader(LabelTable.from_json(table))


@dataclass(kw_only=True, eq=False, repr=False)
class Stanford2D3DS(StanfordAreas, PanoramaDataModule):
    """Stanford2D3DS, 13 classes, in the three folds of its authors.

    Raises:
        SettingError: A setting is invalid.
    """

    group = "pano"


@dataclass(kw_only=True, eq=False, repr=False)
class Stanford2D3DSPerspective(StanfordAreas, PhotoDataModule):
    """The photos of Stanford2D3DS, 13 classes, in the three folds of its authors.

    The validation rooms are those of the panoramas if every room has photos and panoramas.

    Raises:
        SettingError: A setting is invalid.
    """

    group = "data"
