"""Stanford2D3DS's photos: 70,496 pinhole images, rendered from the same scans as its panoramas.

On disk, as released::

    root/area_…/data/
      rgb/       camera_<32 hex>_<room>_<n>_frame_<j>_domain_rgb.png       8 bit, 1080×1080
      depth/     camera_…_domain_depth.png       16 bit, z-depth in 1/512 m, 65535 = missing
      semantic/  camera_…_domain_semantic.png    8 bit, see `LabelTable`
      pose/      camera_…_domain_pose.json       `camera_k_matrix`, counted from pixel corners
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from datamodules.core.label_table import CLASSES, LabelTable
from datamodules.core.photo_module import PhotoDataModule, Split
from datamodules.core.photos import Photo, distance_from_z_depth
from datamodules.core.sources import count_labels, in_threads
from datamodules.images.png import read_color_png, read_depth_png
from datamodules.stanford2d3ds.files import (
    AREAS,
    MISSING_DEPTH,
    PictureFiles,
    check_picture,
    list_pictures,
)
from datamodules.stanford2d3ds.splits import StanfordSplits
from tangent_train.errors import DataError
from tangent_train.json_text import parse_json
from tangent_train.registry import registered

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from numpy.typing import NDArray

    from tangent_train.rendering.representations.perspective import PerspectiveRepresentation

__all__ = ["Stanford2D3DSPerspective", "StanfordPhotos", "read_camera_matrix"]

_CENTERS_FROM_CORNERS = np.array([[1, 0, -0.5], [0, 1, -0.5], [0, 0, 1]])


def read_camera_matrix(path: Path) -> NDArray[np.float64]:
    """The camera matrix of a pose file.

    Args:
        path: ``camera_…_domain_pose.json``.

    Returns:
        ``(3, 3)`` K for integer pixel centres (the file counts from pixel corners).

    Raises:
        DataError: The file is missing or broken, or holds no such matrix.
    """
    expected = "a pose file with a camera_k_matrix of 3×3 numbers, without skew"
    try:
        matrix = np.array(parse_json(path.read_bytes())["camera_k_matrix"], np.float64)
    except (OSError, ValueError, KeyError, TypeError, OverflowError) as error:
        found = f"{type(error).__name__}: {error}"
        raise DataError(
            path, found=found, expected=expected, remedy="Copy or extract the file again."
        ) from error
    pinhole = matrix.shape == (3, 3) and np.isfinite(matrix).all() and (np.diag(matrix) > 0).all()
    if not pinhole or matrix[2].tolist() != [0, 0, 1] or matrix[0, 1] or matrix[1, 0]:
        raise DataError(path, found=matrix.tolist(), expected=expected)
    return _CENTERS_FROM_CORNERS @ matrix


class StanfordPhotos:
    """Reads photos.

    Args:
        files: Where they are.
        table: The classes of the instances.
    """

    def __init__(self, files: Sequence[PictureFiles], table: LabelTable) -> None:
        self._files = tuple(files)
        self._table = table

    def __len__(self) -> int:
        return len(self._files)

    def name(self, index: int) -> str:
        """Area, room, camera and frame of a photo, as ``area_3/office_2/<32 hex>/<frame>``."""
        return f"{self._files[index].short_name}/{self._files[index].name.frame}"

    def read(self, index: int) -> Photo:
        """One photo.

        Raises:
            DataError: A file is broken.
        """
        files = self._files[index]
        camera_matrix = read_camera_matrix(files.pose)
        depth = None
        if files.depth is not None:
            steps = read_depth_png(files.depth)
            steps[steps == MISSING_DEPTH] = 0
            depth = distance_from_z_depth(steps, camera_matrix)
        labels = self._table.decode(read_color_png(files.semantic))
        return Photo(read_color_png(files.rgb), depth, labels, camera_matrix)

    def read_strictly(self, index: int) -> Photo:
        """The same, if all its labels are in the class table.

        Raises:
            DataError: A file is broken, or they are not.
        """
        path = self._files[index].semantic
        self._table.check(read_color_png(path), path)
        return self.read(index)

    def readers(self, index: int) -> Iterator[Callable[[], object]]:
        """What reads the files of one photo, one after the other."""
        files = self._files[index]
        yield lambda: read_color_png(files.rgb)
        yield lambda: self._table.check(read_color_png(files.semantic), files.semantic)
        if files.depth is not None:
            depth = files.depth
            yield lambda: read_depth_png(depth)
        yield lambda: read_camera_matrix(files.pose)

    def label_counts(self, index: int) -> NDArray[np.int64]:
        """The pixels of every label of one photo, ``(256,)``.

        Raises:
            DataError: A file is broken.
        """
        return count_labels(self._table.decode(read_color_png(self._files[index].semantic)))


@registered
class Stanford2D3DSPerspective(PhotoDataModule):
    """The photos of Stanford2D3DS, 13 classes, in the three folds of its authors.

    Args:
        root: Folder with ``area_1`` … ``area_6``.
        representation: The camera that all photos are brought to.
        fold: 1, 2 or 3, see `FOLDS`.
        areas: Areas to use, all of which must be there; by default all there are.
        validation_fraction: Share of the training rooms for validation, see `StanfordSplits`; those
            of the panoramas, where every room has both.
        label_table: The class table, when it is not where the release has it.
        **settings: All others of `PhotoDataModule`; the seed also chooses the validation rooms.

    Raises:
        SettingError: A setting that cannot work.
    """

    class_names = ("unknown", *CLASSES)

    def __init__(
        self,
        root: str | Path,
        representation: PerspectiveRepresentation,
        *,
        fold: int = 1,
        areas: Sequence[str] = AREAS,
        validation_fraction: float = 0.1,
        label_table: str | Path | None = None,
        **settings: Any,
    ) -> None:
        super().__init__(representation, **settings)
        self.root = Path(root)
        self.validation_fraction = validation_fraction
        self._division = StanfordSplits(
            root,
            fold=fold,
            areas=areas,
            validation_fraction=validation_fraction,
            seed=self.seed,
            label_table=label_table,
        )

    def find_splits(self) -> dict[Split, StanfordPhotos]:
        """The photos of all splits, checked.

        Raises:
            DataError: Something is missing or cannot be used; a photo sees less than a crop.
        """
        noted = self.problems.noted
        table = self._division.read_label_table(noted)
        files = self._division.divide(
            lambda area: list_pictures(self.root, area, "data", self.with_depth, noted), noted
        )
        photos = [photo for chosen in files.values() for photo in chosen]
        for _ in in_threads(lambda index: self._check(photos[index]), len(photos)):
            pass
        without = self.problems.without
        return {split: StanfordPhotos(without(chosen), table) for split, chosen in files.items()}

    def _check(self, files: PictureFiles) -> None:
        size = check_picture(files, self.problems.noted)
        with self.problems.noted(files):
            camera_matrix = read_camera_matrix(files.pose)
            if size is not None:
                self.check_camera(files.rgb, camera_matrix, size)
