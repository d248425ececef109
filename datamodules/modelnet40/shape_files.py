"""Where the meshes of a data set of shapes are: the two layouts in which ModelNet40 goes around.

By class, as released (``ModelNet40.zip``), or by split::

    root/                                   root/
      airplane/                               modelnet40_train/
        train/  airplane_0001.off  …            airplane_0001.off  …  xbox_0103.off
        test/   airplane_0627.off  …          modelnet40_test/
      …                                         airplane_0627.off  …  xbox_0123.off
      xbox/

The class is the folder, or the name of the file without its number. Other files, hidden ones and
other folders are skipped.
"""

from __future__ import annotations

import os
import re
from typing import TYPE_CHECKING, Literal, NamedTuple

from tangent_train.errors import DataError

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

__all__ = ["MODELNET40", "ShapeFile", "find_shapes"]

_GET_IT = (
    "Get ModelNet40.zip from https://modelnet.cs.princeton.edu and name the unpacked folder in "
    "data.root. Or choose data=synthshapes, which needs no download."
)

MODELNET40 = (
    *("airplane", "bathtub", "bed", "bench", "bookshelf", "bottle", "bowl", "car", "chair", "cone"),
    *("cup", "curtain", "desk", "door", "dresser", "flower_pot", "glass_box", "guitar"),
    *("keyboard", "lamp", "laptop", "mantel", "monitor", "night_stand", "person", "piano"),
    *("plant", "radio", "range_hood", "sink", "sofa", "stairs", "stool", "table", "tent"),
    *("toilet", "tv_stand", "vase", "wardrobe", "xbox"),
)
"""The classes of ModelNet40."""

_PARTS: tuple[Literal["train", "test"], ...] = ("train", "test")
_NUMBERED = re.compile(r"(?P<label>.+)_\d+")
_TREE = "<class>/{train,test}/*.off or modelnet40_{train,test}/<class>_<number>.off"


class ShapeFile(NamedTuple):
    """A mesh of the data set.

    Attributes:
        path: The file.
        name: Its path in the data set, without the suffix.
        label: Name of its class.
        part: What it is for.
    """

    path: Path
    name: str
    label: str
    part: Literal["train", "test"]

    @property
    def parts(self) -> dict[str, Path]:
        """The files that its spheres are made from."""
        return {"mesh": self.path}


def find_shapes(root: Path) -> list[ShapeFile]:
    """All meshes of a data set, ordered by name within each part.

    Args:
        root: Its folder.

    Raises:
        DataError: The folder is missing or holds no such tree, or both layouts; or a class has no
            shape to train on.
    """
    if not root.is_dir():
        raise DataError(root, found="no such folder", expected="the data set", remedy=_GET_IT)
    try:
        by_class, by_split = list(_by_class(root)), list(_by_split(root))
    except OSError as error:
        raise DataError(
            error.filename, found=os.strerror(error.errno or 0), expected="a folder of meshes"
        ) from error
    if by_class and by_split:
        raise DataError(
            root,
            found=f"both {by_class[0].name} and {by_split[0].name}",
            expected=f"one of {_TREE}",
            remedy="Remove one of the two.",
        )
    shapes = sorted(by_class or by_split, key=lambda shape: (shape.part, shape.name))
    if not shapes:
        raise DataError(root, found="no meshes", expected=_TREE, remedy=_where(root) or _GET_IT)
    training = {shape.label for shape in shapes if shape.part == "train"}
    if untrained := sorted({shape.label for shape in shapes} - training):
        raise DataError(
            root,
            found=f"only test shapes of {', '.join(untrained)}",
            expected="shapes to train on of every class",
        )
    return shapes


def _by_class(root: Path) -> Iterator[ShapeFile]:
    for folder in _folders(root):
        for part in _PARTS:
            for path in _meshes(folder / part):
                yield ShapeFile(path, f"{folder.name}/{part}/{path.stem}", folder.name, part)


def _by_split(root: Path) -> Iterator[ShapeFile]:
    for part in _PARTS:
        folder = root / f"modelnet40_{part}"
        for path in _meshes(folder):
            match = _NUMBERED.fullmatch(path.stem)
            if match is None:
                raise DataError(path, found="a name without class", expected="<class>_<number>.off")
            yield ShapeFile(path, f"{folder.name}/{path.stem}", match["label"], part)


def _meshes(folder: Path) -> Iterator[Path]:
    if folder.is_dir():
        for path in folder.iterdir():
            if path.suffix.lower() == ".off" and not path.name.startswith("."):
                yield path


def _folders(folder: Path) -> list[Path]:
    return sorted(p for p in folder.iterdir() if p.is_dir() and not p.name.startswith("."))


def _where(root: Path) -> str:
    """The remedy where the tree is one folder further down."""
    for folder in _folders(root):
        if any(_by_class(folder)) or any((folder / f"modelnet40_{p}").is_dir() for p in _PARTS):
            return f"Set data.root={folder}."
    return ""
