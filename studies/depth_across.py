"""Scales of two panoramas with known poses: python -m studies.depth_across 00.png 01.png.

Points of a model are 300 known distances of each panorama, with 2 % of noise, a tenth of them
wrong by up to a factor of 3.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from tangent_train.files import csv_text, write_text
from tangent_train.geometry import PanoramaPose, equirect_to_lonlat, lonlat_to_xyz
from tangent_train.heads.scales import frame_scales, pose_scales
from tangent_train.io.camera_files import read_poses
from tangent_train.io.pixel_files import read_depth_m
from tangent_train.rendering.resampling import resize

COLUMNS = (
    *("smooth error %", "step before %", "step %", "ratio error %", "unit error %"),
    *("difference from points %", "ratio error with points %", "unit error with points %"),
    "ratio error of frames %",
)


def main() -> None:
    """Print and write the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("depth", type=Path, nargs=2, help="distances in millimeters")
    parser.add_argument("--poses", type=Path, required=True, help="see read_poses")
    parser.add_argument("--draws", type=int, default=20)
    parser.add_argument("--output", type=Path, default=Path("depth_across.csv"))
    given = parser.parse_args()
    maps = np.stack(
        [resize(read_depth_m(path, 1000), (128, 256), "nearest") for path in given.depth]
    )
    rng, rows = np.random.default_rng(0), []
    poses = [pose for _, pose in sorted(read_poses(given.poses).items())]
    for error in (0, 0.05, 0.1, 0.2):
        found = []
        for _ in range(given.draws):
            true, coarse = np.exp(rng.normal(0, 0.4, 2)), rng.normal(0, error, (2, 8, 16))
            smooth = [cv2.resize(one, (256, 128), interpolation=cv2.INTER_CUBIC) for one in coarse]
            seen = maps / true[:, None, None] * np.exp(smooth)
            scales, steps = pose_scales(seen, poses)
            points = [_points(rng, *of) for of in zip(maps, poses, strict=True)]
            by_points, (_, step) = pose_scales(seen, poses, points)
            errors = [np.log(s / true) for s in (scales, by_points, frame_scales(seen)[0])]
            (ratio, unit), of_points, (of_frames, _) = ((np.ptp(e), abs(e.mean())) for e in errors)
            found.append((*steps, ratio, unit, step, *of_points, of_frames))
        rows.append(
            [f"{100 * error:g}", *(float(f"{100 * v:.2g}") for v in np.median(found, axis=0))]
        )
    text = csv_text(COLUMNS, rows)
    print(text)
    write_text(given.output, text)


def _points(rng: np.random.Generator, distance: Any, pose: PanoramaPose) -> Any:
    pixels = rng.permutation(np.argwhere(distance > 0))[:300]
    rays = lonlat_to_xyz(equirect_to_lonlat(pixels[:, ::-1], distance.shape))
    noise = rng.normal(0, 0.02, len(pixels))
    noise[:30] = rng.uniform(-1.1, 1.1, 30)
    return pose.points_m(rays, distance[tuple(pixels.T)] * np.exp(noise))


if __name__ == "__main__":
    main()
