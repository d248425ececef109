"""Meshes of a data set of shapes, in one of the two layouts in which ModelNet40 is distributed.

By class, as released (``ModelNet40.zip``), or by split::

    root/                                   root/
      airplane/                               modelnet40_train/
        train/  airplane_0001.off  …            airplane_0001.off  …  xbox_0103.off
        test/   airplane_0627.off  …          modelnet40_test/
      …                                         airplane_0627.off  …  xbox_0123.off
      xbox/

The class is the folder, or the name of the file without its number. Other files are skipped.
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal, NamedTuple

from tangent_train.errors import DataError

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
_TREE = "<class>/{train,test}/*.off or modelnet40_{train,test}/<class>_<number>.off"


class ShapeFile(NamedTuple):
    """A mesh of the data set.

    Attributes:
        path: File of the mesh.
        name: Path of the file in the data set, without suffix.
        label: Name of the class.
        part: Split of the mesh.
    """

    path: Path
    name: str
    label: str
    part: Literal["train", "test"]

    @property
    def paths(self) -> tuple[Path, ...]:
        """Files that the spheres are computed from."""
        return (self.path,)


def find_shapes(root: Path) -> list[ShapeFile]:
    """List all meshes of a data set, ordered by name within each part.

    Args:
        root: Folder of the data set.

    Raises:
        DataError: The folder is missing or has another layout.
    """
    shapes: list[ShapeFile] = []
    for part in _PARTS:
        for path in (*root.glob(f"*/{part}/*.off"), *root.glob(f"modelnet40_{part}/*.off")):
            by_class = path.parent.name == part
            label = path.parents[1].name if by_class else path.stem.rpartition("_")[0]
            name = path.relative_to(root).with_suffix("").as_posix()
            if not path.name.startswith("."):
                shapes.append(ShapeFile(path, name, label, part))
    if not shapes:
        raise DataError(root, found="no meshes", expected=_TREE, remedy=_GET_IT)
    return sorted(shapes, key=lambda shape: (shape.part, shape.name))
