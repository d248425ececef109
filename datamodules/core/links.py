"""Links in the folders of a data set that lead nowhere, or round in a circle."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

from tangent_train.errors import DataError

if TYPE_CHECKING:
    from collections.abc import Iterable

    from datamodules.core.problems import Noted

__all__ = ["note_links"]


def note_links(folder: Path, names: Iterable[str], noted: Noted) -> set[str]:
    """Note the links in a folder that have to be passed over.

    Args:
        folder: Where they are.
        names: What to look at in it; what begins with a dot is nobody's business.
        noted: Where they go.

    Returns:
        Names of those that were noted.
    """
    wrong = set()
    for name in names:
        path = folder / name
        found = "" if name.startswith(".") else _found(path)
        if found:
            wrong.add(name)
            with noted(path):
                raise DataError(
                    path,
                    found=found,
                    expected="a link to an image or another folder",
                    remedy="Remove it, or point it elsewhere.",
                )
    return wrong


def _found(path: Path) -> str:
    if not path.is_symlink():
        return ""
    target = path.readlink()
    if not path.exists():
        return f"a link to {target}, which is not there or leads back to it"
    holds_it = Path(os.path.realpath(path.parent)).is_relative_to(os.path.realpath(path))
    return f"a link to {target}, a folder that it is in" if holds_it else ""
