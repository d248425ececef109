"""Masks from the label images of a user-defined data set."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from datamodules.core.label_map import read_label_map
from tangent_train.errors import SettingError
from tangent_train.io import image_files
from tangent_train.io.masks import Masks


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
    names, ignored = classes.names, list(map(image_files.composed, ignored))
    if set(ignored) - set(names):
        found = ", ".join(sorted(set(ignored) - set(names)))
        raise SettingError("mask_classes", found=found, expected=f"of {', '.join(names)}")
    labels = [names.index(name) + 1 for name in ignored]
    return Masks(folder / "labels", counts=lambda path: ~np.isin(classes.read_labels(path), labels))
