"""Panoramas of Stanford2D3DS with depth and pose, under the names of the paper's pairs."""

from __future__ import annotations

import hashlib
import shutil
from pathlib import Path

import numpy as np

from datamodules.stanford2d3ds.pairs import published_pairs
from tests.datamodules.data_files import read_png, write_png


def write_paper_pairs(root: Path, rooms: Path) -> Path:
    """All panoramas of the paper's pairs, and two more of the same rooms.

    Args:
        root: Where ``area_1`` comes to be.
        rooms: Synthetic rooms in the same format, whose depth and poses they have.

    Returns:
        The same folder.
    """
    names = {name for pair in published_pairs() for name in (pair.left, pair.right)}
    for number, name in enumerate(sorted(names | {"0123456_hallway_7", "fffffff_office_3"})):
        camera, _, room = name.partition("_")
        filled = camera + hashlib.sha256(name.encode()).hexdigest()[: 32 - len(camera)]
        write_panorama(root, filled, room, rooms, number)
    return root


def write_panorama(root: Path, camera: str, room: str, rooms: Path, number: int = 0) -> None:
    """One panorama of one grey: nothing in it is found in another one, which takes long.

    Args:
        root: Where ``area_1`` comes to be.
        camera: 32 hexadecimal digits.
        room: As ``office_3``.
        rooms: Synthetic rooms in the same format.
        number: Grey, and which of their panoramas it has depth and pose of; they take turns.
    """
    for kind in ("rgb", "depth", "pose"):
        panoramas = sorted(rooms.glob(f"area_1/pano/{kind}/*"))
        panorama = panoramas[number % len(panoramas)]
        name = f"camera_{camera}_{room}_frame_equirectangular_domain_{kind}{panorama.suffix}"
        path = root / "area_1" / "pano" / kind / name
        path.parent.mkdir(parents=True, exist_ok=True)
        if kind == "rgb":
            write_png(path, np.full_like(read_png(panorama), number))
        else:
            shutil.copyfile(panorama, path)
