"""Masks from the label images of a user-defined data set."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from datamodules.core.label_map import read_label_map
from tangent_train.errors import SettingError
from tangent_train.io import image_files
from tangent_train.io.gpano import PanoramaArea
from tangent_train.io.masks import Mask, Masks


def mask_reader(
    masks: Sequence[Mask] | None, ignored: Sequence[str] | None
) -> Callable[[str, PanoramaArea], NDArray[np.uint8]]:
    """Return a function that reads where a panorama counts in all of several masks.

    It has the arguments of `Masks.read`, and returns 255 where all masks count, else 0.

    Args:
        masks: See `Mask`.
        ignored: Names of classes; folders are then those of `class_masks`. None for plain masks.

    Raises:
        DataError: A mask is missing or cannot be used.
        SettingError: There is no such latitude or class.
    """
    each = [
        class_masks(mask, ignored)
        if ignored and isinstance(mask, Path) and mask.is_dir()
        else Masks(mask)
        for mask in masks or [None]
    ]
    return lambda name, area: np.minimum.reduce([mask.read(name, area) for mask in each])


def class_masks(folder: Path, ignored: Sequence[str]) -> Masks:
    """Return masks that ignore all pixels of some classes.

    Args:
        folder: Folder with ``labels/`` and ``classes.json``, as for ``data=folder``.
        ignored: Names of the classes.

    Raises:
        DataError: ``classes.json`` or ``labels/`` is missing or cannot be used.
        SettingError: ``classes.json`` lacks one of the classes.
    """
    classes = read_label_map(folder / "classes.json")
    labels = ignored_labels(classes.names, ignored)
    return Masks(folder / "labels", counts=lambda path: ~np.isin(classes.read_labels(path), labels))


def ignored_labels(names: Sequence[str], ignored: Sequence[str] | None) -> list[int]:
    """Return the labels of the classes to ignore.

    Args:
        names: Names of labels 1 to K.
        ignored: Names of the classes.

    Raises:
        SettingError: There is no such class, or none is given.
    """
    chosen = list(map(image_files.composed, ignored or ()))
    if not chosen or set(chosen) - set(names):
        found = ", ".join(sorted(set(chosen) - set(names))) or "null"
        raise SettingError("mask_classes", found=found, expected=f"of {', '.join(names)}")
    return [names.index(name) + 1 for name in chosen]
