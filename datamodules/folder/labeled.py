"""User-defined folders of images, label images and a list of classes, for panoramas and photos.

On disk::

    root/
      classes.json                  see `read_label_map`
      images/[scene/]…/name.jpg     or .png, .tif, .webp
      labels/[scene/]…/name.png     values or colors of the classes, at the size of the image
      depth/[scene/]…/name.png      or .tif, .npy, .exr, if depth is an input, see `read_depth_m`
      cameras.json                  of photos, if wanted, see `read_folder_cameras`
      train.txt val.txt test.txt    if wanted, names one per line, see `divide_images`
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, NonNegativeInt, PositiveFloat

from datamodules.core.data_module import data_set
from datamodules.core.depth import meters_to_steps
from datamodules.core.files import ImageFiles, Split
from datamodules.core.image_module import ImageDataModule, PanoramaDataModule, PhotoDataModule
from datamodules.core.label_map import LabelMap, read_label_map
from datamodules.folder.cameras import photo_camera, read_folder_cameras
from datamodules.folder.splits import divide_images
from tangent_train.errors import DataError
from tangent_train.io import image_files
from tangent_train.io.pixel_files import read_depth_m


@data_set
class LabeledFolder(ImageDataModule):
    """Files, splits and classes of a user-defined data set. Depth is clipped to 4 m.

    Args:
        test_fraction: Share of the scenes for the test, without lists, see `divide_images`;
            `val_fraction` is a share of the training scenes.
        split_seed: Seed of both splits. Independent of the run's seed, so that runs with
            different seeds share their splits.
        depth_units_per_m: Units per meter of integer depth files, 1000 for millimeters.
        depth_channel: Channel of OpenEXR depth files, see `read_depth_m`.

    Raises:
        DataError: ``classes.json`` is missing or cannot be used.
    """

    cache_settings: ClassVar[tuple[str, ...]] = ("depth_units_per_m", "depth_channel")

    test_fraction: Annotated[float, Field(gt=0, lt=1)] = 0.2
    split_seed: NonNegativeInt = 0
    depth_units_per_m: PositiveFloat = 1000
    depth_channel: str | None = None

    def find_label_map(self) -> LabelMap:
        """Return the classes of ``classes.json``: the network needs their number early."""
        return read_label_map(self.root / "classes.json")

    def files(self) -> Mapping[Split, Sequence[ImageFiles]]:
        """See `DataModule`."""
        images = self._list_images()
        self._note_ignored(images)
        fractions = self.test_fraction, self.val_fraction
        with self.problems.noted():  # all images are checked even without splits
            return divide_images(self.root, images, self.problems, fractions, self.split_seed)
        return {"train": images}  # type: ignore[unreachable]  # the error was noted

    def _list_images(self) -> list[ImageFiles]:
        """Return all images, in the order of their names: paths below ``images/`` without suffix.

        Raises:
            DataError: A folder is missing, or there are no images.
        """
        root, with_labels = self.root, not self.has_distances
        for folder in (root / "images", root / ("labels" if with_labels else "depth")):
            if not folder.is_dir():
                expected = "a data set: images/, labels/ or depth/, see docs/how-to/own_data.md"
                raise DataError(folder, found="no such folder", expected=expected)
        found: dict[str, ImageFiles] = {}
        labels = image_files.NamedFiles(root / "labels")
        depths = image_files.NamedFiles(root / "depth")
        for rgb in image_files.image_paths(root / "images"):
            name = _name(root / "images", rgb)
            files = ImageFiles(name, rgb)
            with self.problems.noted(name):
                if name in found:
                    expected = f"one image of each name, not also {found[name].rgb.name}"
                    raise DataError(rgb, found="another suffix", expected=expected)
                if with_labels:
                    files = files._replace(labels=labels.path(f"{name}.png"))
                if self.reads_depth:
                    remedy = "Or train without depth: data.inputs=[rgb]." if with_labels else ""
                    files = files._replace(depth=image_files.find_depth(depths, name, remedy))
            found.setdefault(name, files)
        return [found[name] for name in sorted(found)]

    def _note_ignored(self, images: Sequence[ImageFiles]) -> None:
        """Warn of files that training passes over: labels of no image, and no images."""
        names = {files.name for files in images}
        folder = self.root / ("depth" if self.has_distances else "labels")
        strays = sorted({_name(folder, path) for path in image_files.walk_files(folder)} - names)
        if strays:
            found = f"{len(strays)} without an image, e.g. {repr(strays[0])[1:-1]}"
            self.problems.warnings.append(f"{folder}: {found}")
        folder = self.root / "images"
        others = {*image_files.walk_files(folder)} - {files.rgb for files in images}
        suffixes = {path.suffix.lower() for path in others}
        if unknown := sorted(suffixes - {*image_files.IMAGE_SUFFIXES}):
            self.problems.warnings.append(f"{folder}: files {', '.join(unknown)} are not images")

    def decode_depth(self, files: ImageFiles) -> NDArray[np.uint16]:
        """See `ImageDataModule`."""
        path: Any = files.depth
        return meters_to_steps(read_depth_m(path, self.depth_units_per_m, self.depth_channel))


@data_set
class FolderPanoramas(LabeledFolder, PanoramaDataModule):
    """User-defined panoramas, with the classes of ``classes.json``."""


@data_set
class FolderPhotos(LabeledFolder, PhotoDataModule):
    """User-defined photos, with the classes of ``classes.json``.

    Args:
        fov: Horizontal field of view, in degrees, of photos that ``cameras.json`` does not name;
            None to read it from EXIF data.
    """

    cache_settings = ("cameras", "fov")

    fov: Annotated[float, Field(gt=0, lt=180)] | None = None

    @cached_property
    def cameras(self) -> dict[str, NDArray[np.float64]]:
        """Cameras of photos and folders."""
        return read_folder_cameras(self.root / "cameras.json")

    def decode_camera(self, files: ImageFiles) -> NDArray[np.float64]:
        """Return the camera by ``cameras.json``, the field of view or the EXIF data."""
        return photo_camera(self.cameras, files, self.fov)


def _name(folder: Path, path: Path) -> str:
    return image_files.composed(path.relative_to(folder).with_suffix("").as_posix())
