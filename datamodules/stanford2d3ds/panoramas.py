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
from typing import TYPE_CHECKING, Any

import numpy as np

from datamodules.core.label_table import CLASSES, LabelTable
from datamodules.core.panorama_module import PanoramaDataModule, Split
from datamodules.core.panoramas import (
    Mask,
    Panorama,
    mask_black,
    resize_area,
    resize_depth,
    resize_nearest,
)
from datamodules.core.sources import count_labels
from datamodules.images.png import read_color_png, read_depth_png
from datamodules.stanford2d3ds.files import (
    AREAS,
    FOLDS,
    MISSING_DEPTH,
    FileName,
    PictureFiles,
    check_panorama,
    list_pictures,
)
from datamodules.stanford2d3ds.poses import read_panorama_pose
from datamodules.stanford2d3ds.splits import StanfordSplits
from tangent_train.errors import SettingError
from tangent_train.registry import registered

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from numpy.typing import NDArray

    from tangent_train.rendering.representations.pinhole import Representation

__all__ = [
    "AREAS",
    "CLASSES",
    "FOLDS",
    "FileName",
    "LabelTable",
    "PictureFiles",
    "Stanford2D3DS",
    "StanfordPanoramas",
]


class StanfordPanoramas:
    """Reads panoramas at one size.

    Args:
        files: Where they are.
        table: The classes of the instances.
        erp_height: Rows to read.
        mask: Which pixels count as unknown, see `mask_black`.
    """

    def __init__(
        self, files: Sequence[PictureFiles], table: LabelTable, erp_height: int, mask: Mask
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
        return self._files[index].short_name

    def read(self, index: int) -> Panorama:
        """One panorama.

        Raises:
            DataError: A file is broken.
        """
        return self._read(index, strict=False)

    def read_strictly(self, index: int) -> Panorama:
        """The same, if all its labels are in the class table.

        Raises:
            DataError: A file is broken, or they are not.
        """
        return self._read(index, strict=True)

    def readers(self, index: int) -> Iterator[Callable[[], object]]:
        """What reads the files of one panorama one by one, and the pose where there is one."""
        files = self._files[index]
        yield lambda: read_color_png(files.rgb)
        yield lambda: self._table.check(read_color_png(files.semantic), files.semantic)
        if files.depth is not None:
            depth = files.depth
            yield lambda: read_depth_png(depth)
        if files.pose.exists():
            yield lambda: read_panorama_pose(files.pose)

    def _read(self, index: int, *, strict: bool) -> Panorama:
        files = self._files[index]
        rgb = read_color_png(files.rgb)
        depth = None if files.depth is None else self._read_depth(files.depth)
        labels = self._labels(files, rgb, strict=strict)
        return Panorama(resize_area(rgb, self._shape), depth, labels)

    def label_counts(self, index: int) -> NDArray[np.int64]:
        """The pixels of every label of one panorama, ``(256,)``.

        Raises:
            DataError: A file is broken.
        """
        files = self._files[index]
        rgb = None if self._mask == "labels" else read_color_png(files.rgb)
        return count_labels(self._labels(files, rgb))

    def _labels(
        self, files: PictureFiles, rgb: NDArray[np.uint8] | None, *, strict: bool = False
    ) -> NDArray[np.uint8]:
        colors = read_color_png(files.semantic)
        if strict:
            self._table.check(colors, files.semantic)
        labels = self._table.decode(resize_nearest(colors, self._shape))
        if rgb is None or self._mask == "labels":
            return labels
        return mask_black(labels, resize_nearest(rgb, self._shape), self._mask)

    def _read_depth(self, path: Path) -> NDArray[np.uint16]:
        steps = read_depth_png(path)
        steps[steps == MISSING_DEPTH] = 0
        return resize_depth(steps, self._shape)


@registered
class Stanford2D3DS(PanoramaDataModule):
    """Stanford2D3DS, 13 classes, in the three folds of its authors.

    Args:
        root: Folder with ``area_1`` … ``area_6``.
        representation: What the network sees of a panorama.
        fold: 1, 2 or 3, see `FOLDS`.
        areas: Areas to use, all of which must be there; by default all there are.
        mask: Which pixels count as unknown, see `mask_black`.
        validation_fraction: Share of the training rooms for validation, see `StanfordSplits`.
        label_table: The class table, when it is not where the release has it.
        **settings: All others of `PanoramaDataModule`; the seed also chooses the validation rooms.

    Raises:
        SettingError: A setting that cannot work.
    """

    class_names = ("unknown", *CLASSES)

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
        if mask not in ("labels", "any_black", "all_black"):
            raise SettingError(
                "data.mask", found=repr(mask), expected="labels, any_black or all_black"
            )
        self.root = Path(root)
        self.mask = mask
        self.validation_fraction = validation_fraction
        self._division = StanfordSplits(
            root,
            fold=fold,
            areas=areas,
            validation_fraction=validation_fraction,
            seed=self.seed,
            label_table=label_table,
        )

    def find_splits(self) -> dict[Split, StanfordPanoramas]:
        """The panoramas of all splits, checked.

        Raises:
            DataError: Something is missing or cannot be used.
            SettingError: The panoramas are too small for the representation.
        """
        noted = self.problems.noted
        table = self._division.read_label_table(noted)
        files = self._division.divide(
            lambda area: list_pictures(self.root, area, "pano", self.with_depth, noted), noted
        )
        for panorama in (picture for pictures in files.values() for picture in pictures):
            check_panorama(panorama, self.erp_height, noted)
        without = self.problems.without
        return {
            split: StanfordPanoramas(without(chosen), table, self.erp_height, self.mask)
            for split, chosen in files.items()
        }
