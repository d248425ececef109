"""Decoder of images and labels of a user."""

from __future__ import annotations

import glob
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from datamodules.core.panoramas import ImageFiles, ImageReader, meters_to_steps, resize_nearest
from datamodules.core.problems import Problems
from datamodules.folder.cameras import FolderCameras
from datamodules.folder.classes import FolderClasses, read_classes
from tangent_train.errors import DataError, SettingError
from tangent_train.io import image_files
from tangent_train.io.masks import Masks
from tangent_train.io.pixel_files import read_depth_m, read_image_size, read_pixels, read_rgb
from tangent_train.io.png import PngHeader, read_png_header

# Allowed formats of label images. Gray of 1 to 4 bits is ambiguous: the stored numbers, or the gray
# levels that they stand for. 16 bits with alpha cannot be decoded.
_VALUES = ("8-bit gray", "16-bit gray", "8-bit gray with alpha", "palette")
_COLORS = ("8-bit RGB", "8-bit RGBA", "8-bit gray", "8-bit gray with alpha", "palette")


@dataclass(frozen=True)
class FolderReader(ImageReader):
    """Decoder of images and labels of a user.

    Attributes:
        classes: Classes of the label images.
        depth_units_per_m: Units per meter of integer depth files.
        cameras: Cameras of photos.
    """

    classes: FolderClasses
    depth_units_per_m: float
    cameras: FolderCameras | None = None

    @property
    def settings(self) -> dict[str, str]:
        """See `ImageReader`: classes, depth units and, for photos, cameras."""
        units = f"{self.depth_units_per_m:g}"
        settings = {"classes": self.classes.fingerprint, "depth units per meter": units}
        return settings | ({"cameras": self.cameras.fingerprint} if self.cameras else {})

    def size(self, part: str, path: Path) -> tuple[int, int]:
        """See `ImageReader`."""
        if part == "labels":
            _check_there(path)
            _check_kind(path, read_png_header(path), in_colors=self.classes.in_colors)
        return read_image_size(path)

    def rgb(self, files: ImageFiles) -> NDArray[np.uint8]:
        """Decode the colors."""
        return read_rgb(files.rgb)

    def labels(self, files: ImageFiles, shape: tuple[int, int] | None = None) -> NDArray[np.uint8]:
        """Return the labels, by ``classes.json``."""
        codes = read_codes(files.parts["labels"], in_colors=self.classes.in_colors)
        codes = codes if shape is None else resize_nearest(codes, shape)
        return self.classes.decode(codes, files.labels)

    def depth(self, files: ImageFiles) -> NDArray[np.uint16]:
        """Read depth in steps of 1/512 m."""
        return meters_to_steps(read_depth_m(files.parts["depth"], self.depth_units_per_m))

    def camera(self, files: ImageFiles) -> NDArray[np.float64]:
        """Read the camera matrix, by ``cameras.json``, the field of view or the EXIF data."""
        return self.cameras.matrix(files) if self.cameras else super().camera(files)


def list_images(
    root: Path, problems: Problems, *, with_labels: bool = True, with_depth: bool
) -> list[ImageFiles]:
    """List all images of a data set, in the order of their names.

    A name is the path of the image in ``images/`` without ending, see `composed`.

    Args:
        root: Folder with ``images/``, ``labels/`` and ``depth/``.
        problems: Collects duplicate names and missing or ambiguous files.
        with_labels: True to list labels.
        with_depth: True to list depth files.

    Raises:
        DataError: A folder is missing, or there are no images.
    """
    labels_in = "labels" if with_labels else "depth"
    for folder in (root, root / "images", root / labels_in):
        if not folder.is_dir():
            others = "labels/ and classes.json" if with_labels else "depth/"
            expected = f"a data set: images/, {others}, see docs/how-to/own_data.md"
            raise DataError(folder, found="no such folder", expected=expected)
    found: dict[str, ImageFiles] = {}
    labels = image_files.NamedFiles(root / "labels")
    depths = image_files.NamedFiles(root / "depth") if with_depth else None
    for rgb in image_files.image_paths(root / "images"):
        name = _name(root / "images", rgb)
        label, depth = labels.folder / f"{name}.png" if with_labels else None, None
        with problems.noted(name):
            if name in found:
                raise DataError(
                    rgb,
                    found=f"{image_files.spelled(found[name].rgb.name)} beside it",
                    expected="one image of each name: its labels have the same one",
                    remedy="Rename or remove one of them.",
                )
            label = labels.path(f"{name}.png") if with_labels else None
            if depths is not None:
                without = "Or train without depth: data.inputs=[rgb]." if with_labels else ""
                depth = image_files.find_depth(depths, name, without)
        found.setdefault(name, ImageFiles(name, rgb, label, depth))
    return [found[name] for name in sorted(found)]


def note_ignored(root: Path, labels: str, problems: Problems) -> None:
    """Note files that training passes over.

    Args:
        root: Folder with ``images/`` and labels, there or not.
        labels: Folder of the labels in it, ``labels`` or ``depth``.
        problems: They are added.
    """
    files = list(image_files.walk_files(root / "images"))
    names = {_name(root / "images", path) for path in files}
    noted = [
        (path, f"{labels} of no image", "Name it as its image, or remove it.")
        for path in image_files.walk_files(root / labels)
        if _name(root / labels, path) not in names
    ]
    others = [path for path in files if path.suffix.lower() not in image_files.IMAGE_SUFFIXES]
    noted += [(path, "no image", "Convert it; of a video, extract frames.") for path in others]
    expected = f"images ({', '.join(image_files.IMAGE_SUFFIXES)}) and {labels} of the same names"
    for path, found, remedy in noted:
        problems.add(DataError(path, found=found, expected=expected, remedy=remedy), str(path))


def _name(folder: Path, path: Path) -> str:
    return image_files.composed(path.relative_to(folder).with_suffix("").as_posix())


def _check_there(path: Path) -> None:
    """Refuse labels that are missing, and name what the user may have taken for them."""
    if not os.path.lexists(path):
        beside = sorted(file.name for file in path.parent.glob(f"{glob.escape(path.stem)}*"))
        raise DataError(
            path,
            found=f"no such file, but {', '.join(beside)}" if beside else "no such file",
            expected="the labels of the image of this name, as PNG",
            remedy="Draw or copy them, export them as PNG (JPEG changes values), name them so.",
        )


def _check_kind(path: Path, header: PngHeader, *, in_colors: bool) -> None:
    kind = f"{header.bits}-bit {header.color}"
    allowed = _COLORS if in_colors else _VALUES
    if kind not in allowed and header.color not in allowed:
        raise DataError(
            path,
            found=kind,
            expected=f"{', '.join(allowed)}: "
            f"classes.json names {'colors' if in_colors else 'values'}",
            remedy="Convert the labels, or describe them in classes.json.",
        )


def read_codes(path: Path, *, in_colors: bool) -> NDArray[np.integer]:
    """Decode a label image.

    Args:
        path: PNG file.
        in_colors: True if classes are colors, not values. The values of a palette image are its
            indices.

    Returns:
        ``(H, W)`` values, or ``(H, W, 3)`` colors, without alpha.

    Raises:
        DataError: The file is broken.
    """
    return read_rgb(path) if in_colors else read_pixels(path, indices=True)


def class_masks(folder: Path, ignored: Sequence[str]) -> Masks:
    """Return masks that ignore all pixels of some classes.

    Args:
        folder: Folder with ``labels/`` and ``classes.json``, as for ``data=folder``.
        ignored: Names of the classes.

    Raises:
        DataError: ``classes.json`` or ``labels/`` is missing or cannot be used.
        SettingError: ``classes.json`` lacks one of the classes.
    """
    classes = read_classes(folder / "classes.json")
    names, ignored = classes.names, list(map(image_files.composed, ignored))
    if set(ignored) - set(names):
        found = ", ".join(sorted(set(ignored) - set(names)))
        raise SettingError("mask_classes", found=found, expected=f"of {', '.join(names)}")
    values = [names.index(name) + 1 for name in ignored]

    def counts(path: Path) -> NDArray[np.bool_]:
        codes = read_codes(path, in_colors=classes.in_colors)
        return ~np.isin(classes.decode(codes, path), values)

    return Masks(folder / "labels", counts=counts)
