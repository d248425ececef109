"""DensePASS (Ma et al. 2021): 100 labeled and 2,000 unlabeled panoramas of streets, 19 classes.

Features: 400×2048 RGB, all around and about 70° high, with the classes of Cityscapes.

On disk, as released::

    root/
      leftImg8bit/val/cs/1_.png  or  1.png          8 bit
      gtFine/val/cs/1_labelTrainIds.png             8 bit, 0 to 18, 255 = unknown
      leftImg8bit/train/<city>/1.png                unlabeled, for adaptation: not read here

Pixels are square in angle: 400 rows span 400 / 2048 · 360° = 70.3°. The row of the horizon is not
published. The default is the middle, so that the panoramas reach from -35.15° to 35.15°.

License: not stated by its page, https://github.com/chma1024/DensePASS; ask the authors.

Citation: C. Ma, J. Zhang, K. Yang, A. Roitberg, R. Stiefelhagen: "DensePASS: Dense Panoramic
Semantic Segmentation via Unsupervised Domain Adaptation with Attention-Augmented Context Exchange",
ITSC 2021.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated

from pydantic import Field

from datamodules.cityscapes import CLASSES, class_maps
from datamodules.core.data_module import data_set
from datamodules.core.files import ImageFiles, Split
from datamodules.core.image_module import PanoramaDataModule
from datamodules.core.label_map import LabelMap
from tangent_train.io.image_files import glob_files

_HEIGHT, _WIDTH = 400, 2048


@data_set
class DensePASS(PanoramaDataModule):
    """DensePASS, 19 or 13 classes.

    All labeled panoramas are for the test; training and validation are empty.

    Args:
        horizon_row: Rows above the horizon, which define `area`.
    """

    label_maps = class_maps(LabelMap.of(dict(zip(CLASSES, range(19), strict=True)), [255]))
    no_depth = "DensePASS has no depth images"
    get_it = "Get DensePASS from https://github.com/chma1024/DensePASS."

    horizon_row: Annotated[float, Field(ge=0, le=_HEIGHT)] = _HEIGHT / 2

    def __post_init__(self) -> None:
        self.refuse("area", self.area is not None, "null: horizon_row defines it")
        south, north = self.horizon_row - _HEIGHT, self.horizon_row
        self.area = (-180, 180, south * 360 / _WIDTH, north * 360 / _WIDTH)
        super().__post_init__()

    def files(self) -> Mapping[Split, Sequence[ImageFiles]]:
        """See `DataModule`."""
        images, labels = (self.root / kind / "val" / "cs" for kind in ("leftImg8bit", "gtFine"))
        # Two spellings are in circulation: 1_.png and 1.png.
        paths = {path.stem.removesuffix("_"): path for path in glob_files(images, "*.png")}
        test = [ImageFiles(n, paths[n], labels / f"{n}_labelTrainIds.png") for n in sorted(paths)]
        self.problems.compare_counts({"test": test}, {"test": 100})
        return {"test": test}
