"""Masks of panoramas from their labels."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from datamodules.folder.classes import read_classes
from datamodules.folder.reader import read_codes
from datamodules.images.masks import Masks
from tangent_train.errors import SettingError

__all__ = ["class_masks"]


def class_masks(folder: Path, ignored: Sequence[str]) -> Masks:
    """Masks of all pixels of some classes.

    Args:
        folder: With ``labels/`` and ``classes.json``, as of ``data=folder``.
        ignored: Names of the classes.

    Raises:
        DataError: ``classes.json`` or ``labels/`` is missing or cannot be used.
        SettingError: It does not name one of the classes.
    """
    classes = read_classes(folder / "classes.json")
    names = classes.names
    if set(ignored) - set(names):
        found = ", ".join(sorted(set(ignored) - set(names)))
        raise SettingError("mask_classes", found=found, expected=f"of {', '.join(names)}")
    values = [names.index(name) + 1 for name in ignored]

    def counts(path: Path) -> NDArray[np.bool_]:
        codes = read_codes(path, in_colors=classes.in_colors)
        return ~np.isin(classes.decode(codes, path), values)

    return Masks(folder / "labels", counts=counts)
