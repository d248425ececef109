"""Strips of the panoramas of ZInD with labels of their rooms (docs/results/partial_panoramas.md).

python -m studies.strips zind/sample_tour strips
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import cv2

from datamodules.core.files import Problems
from datamodules.zind.homes import list_home_panoramas
from datamodules.zind.layout import CLASSES, DOOR


def write_strips(root: Path, output: Path) -> None:
    """Write a data set for `data=folder` of the 400 of 1024 rows around the horizon.

    Doors are unknown. All but the first panorama are test panoramas.

    Args:
        root: Folder with a folder for every home.
        output: Folder to write.
    """
    for folder in (output / "images", output / "labels"):
        folder.mkdir(parents=True, exist_ok=True)
    (output / "classes.json").write_text(json.dumps([None, *CLASSES]))
    names = []
    for panorama in list_home_panoramas(root, Problems()):
        if panorama.record.layout_visible:
            image = cv2.imread(str(panorama.rgb))
            assert image is not None
            labels = panorama.layout().labels(image.shape[:2])
            rows = slice(len(image) * 312 // 1024, len(image) * 712 // 1024)
            labels[labels == DOOR] = 0
            names.append(panorama.name.replace("/", "_"))
            cv2.imwrite(str(output / "images" / f"{names[-1]}.png"), image[rows])
            cv2.imwrite(str(output / "labels" / f"{names[-1]}.png"), labels[rows])
    (output / "test.txt").write_text("\n".join(names[1:]))  # a data set needs one for training


if __name__ == "__main__":
    write_strips(Path(sys.argv[1]), Path(sys.argv[2]))
