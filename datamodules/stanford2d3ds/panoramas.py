"""Stanford2D3DS (Armeni et al. 2017): six areas of three buildings, 1,413 panoramas, 70,496 photos.

Features: 2048×4096 RGB, depth and 13 semantic classes (`label_table.CLASSES`), captured with a
Matterport camera; all panoramas are upright. Three folds of its authors, by area.

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

Licence: free for research, on request: http://buildingparser.stanford.edu/dataset.html
(`2D-3D-Semantics`, the `noXYZ` archives suffice).

Citation: I. Armeni, S. Sax, A. R. Zamir, S. Savarese: "Joint 2D-3D-Semantic Data for Indoor Scene
Understanding", arXiv:1702.01105, 2017.
"""

from __future__ import annotations

from dataclasses import dataclass

from datamodules.core.image_module import PanoramaDataModule, PhotoDataModule
from datamodules.core.panoramas import Unknown
from datamodules.stanford2d3ds.reader import StanfordReader
from datamodules.stanford2d3ds.splits import StanfordAreas
from tangent_train.registry import registered

__all__ = ["Stanford2D3DS", "Stanford2D3DSPerspective"]


@registered
@dataclass(kw_only=True, eq=False, repr=False)
class Stanford2D3DS(StanfordAreas, PanoramaDataModule):
    """Stanford2D3DS, 13 classes, in the three folds of its authors.

    Args:
        unknown: Pixels that count as unknown, see `mask_black`.

    Raises:
        SettingError: A setting is invalid.
    """

    group = "pano"

    unknown: Unknown = "labels"

    def __post_init__(self) -> None:
        super().__post_init__()
        known = ("labels", "any_black", "all_black")
        self.require("unknown", self.unknown in known, "labels, any_black or all_black")

    @property
    def reader(self) -> StanfordReader:
        """The reader, with the class table and the choice of unknown pixels."""
        return StanfordReader.of(self.root, self.label_table, self.unknown)


@registered
@dataclass(kw_only=True, eq=False, repr=False)
class Stanford2D3DSPerspective(StanfordAreas, PhotoDataModule):
    """The photos of Stanford2D3DS, 13 classes, in the three folds of its authors.

    Validation rooms are those of the panoramas, where every room has both.

    Raises:
        SettingError: A setting is invalid.
    """

    group = "data"
