"""Stanford2D3DS's photos: 70,496 pinhole images, rendered from the same scans as its panoramas.

On disk, as released::

    root/area_…/data/
      rgb/       camera_<32 hex>_<room>_<n>_frame_<j>_domain_rgb.png       8 bit, 1080×1080
      depth/     camera_…_domain_depth.png       16 bit, z-depth in 1/512 m, 65535 = missing
      semantic/  camera_…_domain_semantic.png    8 bit, see `LabelTable`
      pose/      camera_…_domain_pose.json       `camera_k_matrix`, counted from pixel corners

Licence, citation and class table are those of the panoramas.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from datamodules.core.photo_module import PhotoDataModule
from datamodules.stanford2d3ds.files import AREAS
from datamodules.stanford2d3ds.label_table import CLASSES
from datamodules.stanford2d3ds.reader import StanfordReader
from datamodules.stanford2d3ds.splits import check_choice, find_pictures
from tangent_train.registry import registered

if TYPE_CHECKING:
    from datamodules.core.found import Split
    from datamodules.core.problems import Problems
    from datamodules.core.reading import ImageFiles

__all__ = ["Stanford2D3DSPerspective"]


@registered
@dataclass(kw_only=True, eq=False, repr=False)
class Stanford2D3DSPerspective(PhotoDataModule):
    """The photos of Stanford2D3DS, 13 classes, in the three folds of its authors.

    Validation rooms are those of the panoramas, where every room has both.

    Args:
        fold: 1, 2 or 3, see `FOLDS`.
        areas: Areas to use, all of which must be there; by default all.
        label_table: The class table, when it is not where the release has it.

    Raises:
        SettingError: A setting that cannot work.
    """

    class_names = ("unknown", *CLASSES)

    fold: int = 1
    areas: Sequence[str] = AREAS
    label_table: Path | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        self.label_table = None if self.label_table is None else Path(self.label_table)
        check_choice(self.fold, self.areas)

    def find_images(
        self, problems: Problems
    ) -> tuple[StanfordReader, dict[Split, list[ImageFiles]]]:
        """See `PhotoDataModule`."""
        splits = find_pictures(
            self.root,
            "data",
            problems,
            fold=self.fold,
            areas=self.areas,
            with_depth="depth" in self.inputs,
            validation_fraction=self.validation_fraction,
            seed=self.seed,
        )
        return StanfordReader.of(self.root, self.label_table), splits
