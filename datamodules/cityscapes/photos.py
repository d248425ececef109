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

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from datamodules.cityscapes.classes import CLASS_SETS
from datamodules.core.image_module import PhotoDataModule
from datamodules.core.index import Split, published_splits
from datamodules.core.inputs import Input
from datamodules.core.numbered import NumberedReader, number_table
from datamodules.core.panoramas import ImageFiles
from datamodules.core.problems import Problems
from tangent_train.errors import DataError
from tangent_train.files import check_fields, read_json
from tangent_train.geometry import camera_matrix_from_fov, is_camera_matrix
from tangent_train.io.pixel_files import read_image_size

_GET_IT = (
    "Get leftImg8bit, gtFine and camera (…_trainvaltest.zip) from "
    "https://www.cityscapes-dataset.com and point data.root at the folder that holds them."
)
_PUBLISHED = {"train": 2975, "val": 500}
_IDS = (7, 8, 11, 12, 13, 17, *range(19, 29), 31, 32, 33)
_TABLE = number_table(_IDS, [*range(34), 255])  # 255: license plates, id -1
_CAMERA = '{"intrinsic": {"fx": …, "fy": …, "u0": …, "v0": …}}, in pixels'


@dataclass(frozen=True, eq=False)
class CityscapesReader(NumberedReader):
    """Decoder of the files of Cityscapes.

    Attributes:
        fov: Horizontal field of view of all photos in degrees; None to read the camera files.
    """

    fov: float | None = None

    def labels(self, files: ImageFiles, shape: tuple[int, int] | None = None) -> NDArray[np.uint8]:
        """Return the labels; refuse the dummies of the test images."""
        labels = super().labels(files, shape)
        if not labels.any():
            raise DataError(
                files.labels,
                found="no pixel with a class",
                expected="labels of the training or validation images",
                remedy="Those of the test images are dummies (ids 0 to 3): scores on them come "
                "from the benchmark's server only.",
            )
        return labels

    def camera(self, files: ImageFiles) -> NDArray[np.float64]:
        """Read the camera; u0 and v0 count from the center of the first pixel."""
        size, path = read_image_size(files.rgb), files.camera
        if path is None:
            return camera_matrix_from_fov(self.fov or 0, size)
        kinds = dict.fromkeys(("fx", "fy", "u0", "v0"), float)
        content = check_fields(path, read_json(path, _CAMERA), {"intrinsic": dict}, _CAMERA)
        fx, fy, x, y = check_fields(
            path, content["intrinsic"], kinds, _CAMERA, "intrinsic"
        ).values()
        matrix = np.array([[fx, 0, x], [0, fy, y], [0, 0, 1]])
        if not (is_camera_matrix(matrix) and 0 <= x < size[1] and 0 <= y < size[0]):
            found = f"fx={fx}, fy={fy}, u0={x}, v0={y}"
            raise DataError(path, found=found, expected=f"{_CAMERA} of {files.rgb}")
        return matrix


@dataclass(kw_only=True, eq=False, repr=False)
class Cityscapes(PhotoDataModule):
    """Cityscapes, 19 or 13 classes.

    The published validation images are the test split: whole training cities are drawn for
    validation, at least one, so that nothing is selected on the test images.

    Args:
        fov: Horizontal field of view of all photos in degrees, instead of the camera files.

    Raises:
        SettingError: A setting is invalid.
    """

    class_sets = CLASS_SETS
    no_depth = "disparities are not read"

    inputs: Sequence[Input] = ("rgb",)
    fov: float | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        fine = self.fov is None or 0 < self.fov < 180
        self.require("fov", fine, "degrees, more than 0 and less than 180; or null")

    def find_images(
        self, problems: Problems
    ) -> tuple[CityscapesReader, dict[Split, Sequence[ImageFiles]]]:
        """See `ImageDataModule`."""
        published: dict[Split, list[ImageFiles]] = {
            "train": self._list_images("train"),
            "val": self._list_images("val"),
        }
        problems.compare_counts(published, _PUBLISHED)
        for split, images in published.items():
            labels = (self.root / "gtFine" / split).glob("*/[!.]*_labelIds.png")
            problems.note_strays(labels, images)
        splits = published_splits(published, "val", self.val_fraction, self.seed)
        return CityscapesReader(_TABLE, self.fov), splits

    def _list_images(self, split: str) -> list[ImageFiles]:
        """Return the images of a published split, in the order of their names."""
        for folder in ("leftImg8bit", "gtFine", *["camera"] * (self.fov is None)):
            if not (self.root / folder / split).is_dir():
                without = "; data.fov=48.7 replaces the camera files" * (folder == "camera")
                raise DataError(
                    self.root / folder / split,
                    found="no such folder",
                    expected=f"the files of the release{without}",
                    remedy=_GET_IT,
                )
        found = []
        for rgb in sorted((self.root / "leftImg8bit" / split).glob("*/[!.]*_leftImg8bit.png")):
            city, stem = rgb.parent.name, rgb.name.removesuffix("_leftImg8bit.png")
            labels, camera = (
                self.root / kind / split / city / f"{stem}_{end}"
                for kind, end in (("gtFine", "gtFine_labelIds.png"), ("camera", "camera.json"))
            )
            name = f"{city}/{stem.removeprefix(f'{city}_')}"
            found.append(ImageFiles(name, rgb, labels, None, None if self.fov else camera))
        return found
