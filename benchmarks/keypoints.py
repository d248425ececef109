"""Time to find keypoints, on a panorama and on tangent images: ``python -m benchmarks keypoints``.

The panorama is a furnished room.
"""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

import cv2
import torch

from benchmarks.measuring import Table, Way, measure
from benchmarks.report import table_text
from benchmarks.rooms import made_rooms
from tangent_train.geometry import TangentGrid, equirect_shape
from tangent_train.keypoints import Detector, detect_on_equirect, detect_on_tangent_images

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


def main(arguments: list[str] | None = None) -> None:
    """Make the panorama, then print what was measured."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks keypoints", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="a low level and few rounds")
    parser.add_argument("--level", type=int, default=9, help="of the panorama")
    parser.add_argument("--rounds", type=int, default=5, help="measurements per row")
    options = parser.parse_args(arguments)
    level, rounds = (7, 1) if options.quick else (options.level, options.rounds)
    panorama = furnished_room(level)
    height, width = panorama.shape[:2]
    print(f"keypoints, level {level}: {height}×{width}, {torch.get_num_threads()} threads")
    for name in ("sift", "orb"):
        rows = measure(detection_ways(panorama, Detector(name), level), rounds)
        print(table_text(Table(f"keypoints: {name}", f"\n{name}, margin 32", rows)))


def furnished_room(level: int) -> NDArray[np.uint8]:
    """A panorama of a made room."""
    file = sorted(made_rooms(equirect_shape(level)[0]).glob("area_1/pano/rgb/*.png"))[0]
    image: Any = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
    return image


def detection_ways(panorama: NDArray[np.uint8], detector: Detector, level: int) -> list[Way]:
    """The panorama itself, then base levels 0 to 2."""

    def way(name: str, run: Any, *, ours: bool = False) -> Way:
        return Way(f"{name}: {len(run())} keypoints", run, ours)

    def tangent(base_level: int) -> Way:
        grid = TangentGrid(base_level, level)
        return way(
            f"{grid.num_images} tangent images, b = {base_level}",
            lambda: detect_on_tangent_images(panorama, grid, detector),
            ours=True,
        )

    first = way("the panorama itself", lambda: detect_on_equirect(panorama, detector))
    return [first, *map(tangent, range(3))]
