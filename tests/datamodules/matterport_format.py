"""Files of the panoramas of Matterport3D in both releases."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from tests.datamodules.data_files import write_png

SCENES = ("17DRP5sb8fy", "2azQ1b91cZZ", "2t7WUuJeko7", "VFuaQ6m2Qom", "UwV83HsGsw3")
"""360fv: train, val, test, train, test; sfss: train, train, train, test, val."""

FOLDERS = {
    "360fv": ("rgb", "semantic", "depth"),
    "sfss": tuple(
        f"panorama/{name}"
        for name in ("undistorted_color_images", "segmentation_maps_classes",
                     "undistorted_depth_images")
    ),
}  # fmt: skip


def write_matterport(root: Path, scenes: Sequence[str] = SCENES, height: int = 32) -> Path:
    """Two panoramas of each scene in both releases.

    Labels are stripes of all numbers, with 1,500 units of depth each. The colors of the second
    panorama of 360fv are a JPEG file. A fifth of the rows is black.
    """
    numbers = np.broadcast_to(np.arange(2 * height) % 42, (height, 2 * height)).astype(np.uint8)
    color = np.full((height, 2 * height, 3), 90, np.uint8)
    color[: height // 5] = 0
    for scene in scenes:
        for release, folders in FOLDERS.items():
            for k, ending in enumerate(("png", "jpg" if release == "360fv" else "png")):
                rgb, semantic, depth = (root / scene / folder for folder in folders)
                write_png(rgb / f"{k}{scene}.{ending}", color)
                write_png(semantic / f"{k}{scene}.png", numbers)
                write_png(depth / f"{k}{scene}.png", 1500 * numbers.astype(np.uint16))
    return root
