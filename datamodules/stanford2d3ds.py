"""Stanford2D3DS (Armeni et al. 2017): 1,413 panoramas of six areas of three buildings.

On disk, as released::

    root/
      semantic_labels.json            (or assets/semantic_labels.json)
      area_1/ area_2/ area_3/ area_4/ area_5a/ area_5b/ area_6/
        pano/
          rgb/       camera_<32 hex>_<room>_<n>_frame_equirectangular_domain_rgb.png       8 bit
          depth/     camera_…_domain_depth.png       16 bit, 1/512 m, 65535 = missing
          semantic/  camera_…_domain_semantic.png    8 bit, see `LabelTable`

The files are 2048×4096. The data set is free for research, on request:
http://buildingparser.stanford.edu/dataset.html (`2D-3D-Semantics`, the `noXYZ` archives suffice).
"""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from datamodules.label_table import CLASSES, LabelTable
from datamodules.panorama_module import PanoramaDataModule, Split
from datamodules.panoramas import (
    Mask,
    Panorama,
    count_labels,
    mask_black,
    resize_area,
    resize_depth,
    resize_nearest,
)
from datamodules.png import read_color_png, read_depth_png
from datamodules.stanford_files import (
    AREAS,
    FOLDS,
    GET_IT,
    FileName,
    PanoramaFiles,
    check_panorama,
    list_panoramas,
)
from tangent_train.errors import DataError, SettingError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from tangent_train.rendering.representation import Representation

__all__ = [
    "AREAS",
    "CLASSES",
    "FOLDS",
    "FileName",
    "LabelTable",
    "PanoramaFiles",
    "Stanford2D3DS",
    "StanfordPanoramas",
]

_MISSING_DEPTH = 65535
_TABLE_NAME = "semantic_labels.json"


class StanfordPanoramas:
    """Reads panoramas at one size.

    Args:
        files: Where they are.
        table: The classes of the instances.
        erp_height: Rows to read.
        mask: Which pixels count as unknown, see `mask_black`.
    """

    def __init__(
        self, files: Sequence[PanoramaFiles], table: LabelTable, erp_height: int, mask: Mask
    ) -> None:
        self._files = tuple(files)
        self._table = table
        self._shape = (erp_height, 2 * erp_height)
        self._mask = mask

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the panoramas."""
        return self._shape

    @property
    def variant(self) -> str:
        """Size and mask."""
        return f"{self._shape[0]}x{self._shape[1]}_{self._mask}"

    @property
    def settings(self) -> dict[str, str]:
        """Size, mask, and the class table in short."""
        classes = hashlib.sha256(self._table.class_ids.tobytes()).hexdigest()
        return {"size and mask": self.variant, "class table": classes[:16]}

    def files(self, index: int) -> dict[str, Path]:
        """The file of every part of one panorama."""
        files = self._files[index]
        depth = {} if files.depth is None else {"depth": files.depth}
        return {"rgb": files.rgb, "labels": files.semantic, **depth}

    def __len__(self) -> int:
        return len(self._files)

    def name(self, index: int) -> str:
        """Area, room and camera of a panorama, as ``area_3/office_2/<32 hex>``."""
        area, name = self._files[index][:2]
        return f"area_{area}/{name.room}_{name.room_number}/{name.camera}"

    def read(self, index: int) -> Panorama:
        """One panorama.

        Raises:
            DataError: A file is broken.
        """
        files = self._files[index]
        rgb = read_color_png(files.rgb)
        depth = None if files.depth is None else self._read_depth(files.depth)
        return Panorama(resize_area(rgb, self._shape), depth, self._labels(files, rgb))

    def label_counts(self, index: int) -> NDArray[np.int64]:
        """The pixels of every label of one panorama, ``(256,)``.

        Raises:
            DataError: A file is broken.
        """
        files = self._files[index]
        rgb = None if self._mask == "labels" else read_color_png(files.rgb)
        return count_labels(self._labels(files, rgb))

    def _labels(self, files: PanoramaFiles, rgb: NDArray[np.uint8] | None) -> NDArray[np.uint8]:
        labels = self._table.decode(resize_nearest(read_color_png(files.semantic), self._shape))
        if rgb is None or self._mask == "labels":
            return labels
        return mask_black(labels, resize_nearest(rgb, self._shape), self._mask)

    def _read_depth(self, path: Path) -> NDArray[np.uint16]:
        steps = read_depth_png(path)
        steps[steps == _MISSING_DEPTH] = 0
        return resize_depth(steps, self._shape)


class Stanford2D3DS(PanoramaDataModule):
    """Stanford2D3DS, 13 classes, in the three folds of its authors.

    Validation panoramas are those of whole rooms drawn from the training areas, so that nothing
    is ever chosen by the test areas.

    Args:
        root: Folder with ``area_1`` … ``area_6``.
        representation: What the network sees of a panorama.
        fold: 1, 2 or 3, see `FOLDS`.
        areas: Areas to use, all of which must be there; by default all there are.
        mask: Which pixels count as unknown, see `mask_black`.
        validation_fraction: Share of the training rooms for validation: at least one room, never
            all; 0 for no validation.
        label_table: The class table, when it is not where the release has it.
        **settings: All others of `PanoramaDataModule`; the seed also chooses the validation rooms.

    Raises:
        SettingError: A setting that cannot work.
    """

    class_names: ClassVar[tuple[str, ...]] = ("unknown", *CLASSES)

    def __init__(
        self,
        root: str | Path,
        representation: Representation,
        *,
        fold: int = 1,
        areas: Sequence[str] = AREAS,
        mask: Mask = "labels",
        validation_fraction: float = 0.1,
        label_table: str | Path | None = None,
        **settings: Any,
    ) -> None:
        super().__init__(representation, **settings)
        if fold not in FOLDS:
            raise SettingError("data.fold", found=repr(fold), expected="1, 2 or 3")
        if mask not in ("labels", "any_black", "all_black"):
            raise SettingError(
                "data.mask", found=repr(mask), expected="labels, any_black or all_black"
            )
        if not 0 <= validation_fraction < 1:
            raise SettingError(
                "data.validation_fraction", found=validation_fraction, expected="0 to below 1"
            )
        testing = set(FOLDS[fold])
        if not set(areas) <= set(AREAS) or not testing & set(areas) or set(areas) <= testing:
            raise SettingError(
                "data.areas",
                found=list(areas),
                expected=f"some of {', '.join(AREAS)}: for testing (fold {fold}: "
                f"{', '.join(FOLDS[fold])}) and for training (others)",
            )
        self.root = Path(root)
        self.fold = fold
        self.areas = tuple(areas)
        self.mask = mask
        self.validation_fraction = validation_fraction
        self._label_table = None if label_table is None else Path(label_table)
        self._splits: dict[Split, StanfordPanoramas] = {}

    def setup(self, stage: str | None = None) -> None:
        """Find the files and check all that can be checked without decoding them.

        Args:
            stage: Ignored: what a test will need is checked before training already.

        Raises:
            DataError: Something is missing or cannot be used.
            SettingError: The panoramas are too small for the representation.
        """
        if self._splits:
            return
        self._check_layout()
        table = LabelTable.from_json(self._find_table())
        files = [f for area in self.areas for f in list_panoramas(self.root, area, self.with_depth)]
        for panorama in files:
            check_panorama(panorama, self.erp_height)
        testing = [f for f in files if f.area in FOLDS[self.fold]]
        training = [f for f in files if f.area not in FOLDS[self.fold]]
        rooms = self._choose_rooms(training)
        splits: dict[Split, list[PanoramaFiles]] = {
            "train": [f for f in training if f.room not in rooms],
            "val": [f for f in training if f.room in rooms],
            "test": testing,
        }
        self._splits = {
            split: StanfordPanoramas(chosen, table, self.erp_height, self.mask)
            for split, chosen in splits.items()
        }

    def open_split(self, split: Split) -> StanfordPanoramas:
        """The panoramas of one split."""
        self.setup()
        return self._splits[split]

    def _check_layout(self) -> None:
        if not self.root.is_dir():
            raise DataError(
                self.root, found="no such folder", expected="the data set", remedy=GET_IT
            )
        missing = [
            f"area_{area}" for area in self.areas if not (self.root / f"area_{area}").is_dir()
        ]
        if missing:
            raise DataError(
                self.root,
                found="no " + ", ".join(missing),
                expected="all of " + ", ".join(f"area_{area}" for area in self.areas),
                remedy=GET_IT,
            )

    def _find_table(self) -> Path:
        if self._label_table is not None:
            return self._label_table
        places = (self.root / _TABLE_NAME, self.root / "assets" / _TABLE_NAME)
        for place in places:
            if place.is_file():
                return place
        raise DataError(
            places[0],
            found="no class table",
            expected=f"it there or at {places[1]}",
            remedy="Copy it from the release (assets), or name it in data.label_table.",
        )

    def _choose_rooms(self, files: Sequence[PanoramaFiles]) -> set[tuple[str, str, int]]:
        """Draw the rooms for validation, the same for the same seed."""
        if self.validation_fraction == 0:
            return set()
        rooms = sorted({panorama.room for panorama in files})
        if len(rooms) == 1:
            raise DataError(
                self.root,
                found="one training room",
                expected="two or more, to keep some for validation",
                remedy="Set data.validation_fraction=0, or use more rooms.",
            )
        count = min(max(1, round(self.validation_fraction * len(rooms))), len(rooms) - 1)
        order = np.random.default_rng(self.seed).permutation(len(rooms))
        return {rooms[i] for i in order[:count]}
