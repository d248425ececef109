"""Panoramas of Stanford2D3DS with depth and pose, under the names of the paper's pairs."""

from __future__ import annotations

import hashlib
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from datamodules.stanford2d3ds.pairs import published_pairs
from tangent_train.geometry import rotation_about
from tests.datamodules.data_files import write_png


def write_paper_pairs(root: Path, rows: int = 8) -> Path:
    """All panoramas of the paper's pairs, and two more of the same rooms.

    Args:
        root: Where ``area_1`` comes to be.
        rows: Rows of the panoramas.

    Returns:
        The same folder.
    """
    names = {name for pair in published_pairs() for name in (pair.left, pair.right)}
    for name in sorted(names | {"0123456_hallway_7", "fffffff_office_3"}):
        camera, _, room = name.partition("_")
        filled = camera + hashlib.sha256(name.encode()).hexdigest()[: 32 - len(camera)]
        write_panorama(root, filled, room, int(camera, 16) % 200, rows)
    return root


def write_panorama(root: Path, camera: str, room: str, gray: int, rows: int = 8) -> Path:
    """One panorama of one gray, 2 m all around, its uppermost row without depth.

    Args:
        root: Where ``area_1`` comes to be.
        camera: 32 hexadecimal digits.
        room: As ``office_3``.
        gray: Value of all pixels, which also determines the pose.
        rows: Rows of the panorama.

    Returns:
        The colors' file.
    """
    pano = root / "area_1" / "pano"
    stem = f"camera_{camera}_{room}_frame_equirectangular_domain"
    pictures: dict[str, Any] = {
        "rgb": np.full((rows, 2 * rows, 3), gray, np.uint8),
        "depth": np.full((rows, 2 * rows), 1024, np.uint16),
    }
    pictures["depth"][0] = 65535
    for kind, picture in pictures.items():
        write_png(pano / kind / f"{stem}_{kind}.png", picture)
    (pano / "pose").mkdir(exist_ok=True)
    upright = rotation_about((0, 0, 1), gray / 50) @ rotation_about((1, 0, 0), math.pi / 2)
    rotation = np.diag([1.0, -1, -1]) @ upright.T
    location = np.array([gray / 10, 1.0, 1.5])
    record = {
        "camera_k_matrix": [[rows / 2, 0, rows / 2], [0, rows / 2, rows / 2], [0, 0, 1]],
        "camera_rt_matrix": np.hstack([rotation, -(rotation @ location)[:, None]]).tolist(),
        "camera_original_rotation": Rotation.from_matrix(upright).as_euler("xyz").tolist(),
        "camera_location": location.tolist(),
    }
    (pano / "pose" / f"{stem}_pose.json").write_text(json.dumps(record))
    return pano / "rgb" / f"{stem}_rgb.png"
