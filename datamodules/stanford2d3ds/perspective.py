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

from dataclasses import dataclass

from datamodules.core.photo_module import PhotoDataModule
from datamodules.stanford2d3ds.splits import StanfordAreas
from tangent_train.registry import registered

__all__ = ["Stanford2D3DSPerspective"]


@registered
@dataclass(kw_only=True, eq=False, repr=False)
class Stanford2D3DSPerspective(StanfordAreas, PhotoDataModule):
    """The photos of Stanford2D3DS, 13 classes, in the three folds of its authors.

    Validation rooms are those of the panoramas, where every room has both.

    Raises:
        SettingError: A setting is invalid.
    """

    group = "data"
