"""Cityscapes (Cordts et al. 2016): 5,000 photos of streets in 50 cities, 19 classes.

Features: 1024×2048 RGB from a camera behind the windshield, labels by hand, a camera file for every
photo. The field of view is about 49° × 26°: square crops of 45° do not fit, so that
`representation.dim` is lower than wide.

On disk, as released (`leftImg8bit_trainvaltest`, `gtFine_trainvaltest`, `camera_trainvaltest`)::

    root/
      leftImg8bit/train/aachen/aachen_000000_000019_leftImg8bit.png    8 bit; val: 3 cities
      gtFine/train/aachen/aachen_000000_000019_gtFine_labelIds.png     8 bit, ids 0 to 33
      camera/train/aachen/aachen_000000_000019_camera.json             fx, fy, u0, v0

The images of ``test`` are not read: their label images are dummies.

License: non-commercial purposes such as research, https://www.cityscapes-dataset.com/license.

Citation: M. Cordts, M. Omran, S. Ramos, T. Rehfeld, M. Enzweiler, R. Benenson, U. Franke, S. Roth,
B. Schiele: "The Cityscapes Dataset for Semantic Urban Scene Understanding", CVPR 2016.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, Field, PositiveFloat

from datamodules.core.data_module import data_set
from datamodules.core.files import ImageFiles, Split
from datamodules.core.image_module import PhotoDataModule
from datamodules.core.label_map import LabelMap
from tangent_train.files import read_json
from tangent_train.geometry import camera_matrix_from_fov
from tangent_train.io.image_files import glob_files
from tangent_train.io.pixel_files import read_image_size

CLASSES: tuple[str, ...] = (
    *("road", "sidewalk", "building", "wall", "fence", "pole", "traffic light"),
    *("traffic sign", "vegetation", "terrain", "sky", "person", "rider", "car"),
    *("truck", "bus", "train", "motorcycle", "bicycle"),
)
"""The 19 classes in the order of `trainId`; the label of a class is its index plus one."""

THIRTEEN: tuple[str, ...] = (*CLASSES[:12], "car")
"""The classes of the adaptation benchmarks CS13, SP13 and DP13."""

_GROUPS = {"rider": "person", **dict.fromkeys(("truck", "bus", "motorcycle", "bicycle"), "car")}
_IDS = (7, 8, 11, 12, 13, 17, *range(19, 29), 31, 32, 33)
_UNKNOWN = [*sorted(set(range(34)) - set(_IDS)), 255]  # 255: license plates, id -1
_CAMERA = '{"intrinsic": {"fx": …, "fy": …, "u0": …, "v0": …}}, in pixels'


def class_maps(label_map: LabelMap) -> dict[str, LabelMap]:
    """Return the label maps of the setting `classes`: all 19 classes, or the 13.

    Trains are unknown in the 13 classes.

    Args:
        label_map: Label map of the 19 classes.
    """
    return {"19": label_map, "13": label_map.regrouped(THIRTEEN, _GROUPS)}


class _Intrinsic(BaseModel):
    fx: PositiveFloat
    fy: PositiveFloat
    u0: float
    v0: float


class _CameraFile(BaseModel):
    intrinsic: _Intrinsic


@data_set
class Cityscapes(PhotoDataModule):
    """Cityscapes, 19 or 13 classes.

    The published validation images are the test split: whole training cities are drawn for
    validation, at least one, so that nothing is selected on the test images.

    Args:
        fov: Horizontal field of view of all photos in degrees, instead of the camera files.
    """

    label_maps = class_maps(LabelMap.of(dict(zip(CLASSES, _IDS, strict=True)), _UNKNOWN))
    no_depth = "disparities are not read"
    get_it = "Get leftImg8bit, gtFine and camera from https://www.cityscapes-dataset.com."
    test_split = "val"
    cache_settings = ("fov",)

    fov: Annotated[float, Field(gt=0, lt=180)] | None = None

    def files(self) -> Mapping[Split, Sequence[ImageFiles]]:
        """See `DataModule`."""
        published: dict[Split, list[ImageFiles]] = {"train": [], "val": []}
        for split, found in published.items():
            for rgb in glob_files(self.root, f"leftImg8bit/{split}/*/*_leftImg8bit.png"):
                city, stem = rgb.parent.name, rgb.name.removesuffix("_leftImg8bit.png")
                labels, camera = (
                    self.root / kind / split / city / f"{stem}_{end}"
                    for kind, end in (("gtFine", "gtFine_labelIds.png"), ("camera", "camera.json"))
                )
                name = f"{city}/{stem.removeprefix(f'{city}_')}"
                found.append(ImageFiles(name, rgb, labels, None, None if self.fov else camera))
        self.problems.compare_counts(published, {"train": 2975, "val": 500})
        return published

    def decode_camera(self, files: ImageFiles) -> NDArray[np.float64]:
        """See `ImageDataModule`; u0 and v0 count from the center of the first pixel."""
        if files.camera is None:
            return camera_matrix_from_fov(self.fov or 0, read_image_size(files.rgb))
        remedy = "data.fov=48.7 replaces the camera files."
        camera = read_json(files.camera, _CAMERA, remedy, kind=_CameraFile).intrinsic
        return np.array([[camera.fx, 0, camera.u0], [0, camera.fy, camera.v0], [0, 0, 1]])
