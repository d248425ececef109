"""Small data sets of every kind in the real on-disk formats, and what is done to their files."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from datamodules import FolderPanoramas, ModelNet40, Stanford2D3DS
from datamodules.core.split_module import SplitDataModule
from tangent_train.rendering import EquirectRepresentation
from tests.conftest import fabricate
from tests.datamodules.folder.folder_format import write_data_set
from tests.datamodules.modelnet40.shapes_format import write_tree

ERP = EquirectRepresentation(level=3)
BOTH: Any = ("rgb", "depth")

KINDS = ("folder", "stanford", "shapes")


def write(kind: str, root: Path) -> Path:
    """Write a data set of one of `KINDS`; returns its root."""
    if kind == "folder":
        return write_data_set(root, depth=True)
    return write_tree(root) if kind == "shapes" else fabricate(root)


def module(kind: str, root: Path, **settings: Any) -> SplitDataModule[Any]:
    """Its data module, with depth."""
    if kind == "shapes":
        return ModelNet40(root, ERP, **settings)
    of_images = FolderPanoramas if kind == "folder" else Stanford2D3DS
    return of_images(root, ERP, inputs=BOTH, **settings)


def colors(kind: str, root: Path) -> list[Path]:
    """The files of the colours, or the meshes, in order."""
    pattern = {
        "folder": "images/**/*.*",
        "stanford": "area_*/pano/rgb/*.png",
        "shapes": "**/*.off",
    }
    return sorted(root.glob(pattern[kind]))


def partner(kind: str, path: Path, part: str) -> Path:
    """The labels or the depth of an image.

    Args:
        kind: One of `KINDS`.
        path: From `colors`.
        part: ``labels`` or ``depth``.
    """
    if kind == "folder":
        return path.parents[2] / part / path.parent.name / f"{path.stem}.png"
    domain = "semantic" if part == "labels" else part
    return path.parents[1] / domain / path.name.replace("domain_rgb", f"domain_{domain}")


# --- what is done to files ------------------------------------------------------------------------


def truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-20])


def corrupt(path: Path) -> None:
    """Change bytes in the middle: the header, the chunks and the size stay as they are."""
    content = bytearray(path.read_bytes())
    middle = content.index(b"IDAT") + 12
    content[middle : middle + 8] = bytes(255 - byte for byte in content[middle : middle + 8])
    path.write_bytes(content)


def change(path: Path, edit: Callable[[Any], Any]) -> None:
    """Write an image with other pixels."""
    image = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_UNCHANGED)
    path.write_bytes(cv2.imencode(".png", edit(image))[1].tobytes())


def smaller(path: Path) -> None:
    change(path, lambda image: image[::2, ::2])


def narrower(path: Path) -> None:
    change(path, lambda image: np.ascontiguousarray(image[:, :-4]))


def to_8_bits(path: Path) -> None:
    change(path, lambda image: (image >> 8).astype(np.uint8))


def link_to_itself(path: Path) -> None:
    path.unlink()
    path.symlink_to(path.name)


def past_the_table(path: Path) -> None:
    """A label without an entry, in a pixel that training at half the size never reads."""

    def edit(image: Any) -> Any:
        image[-2, -2] = [521 & 255, 521 >> 8, 0]
        return image

    change(path, edit)
