"""Scales of two panoramas with known poses: python -m studies.depth_across 00.png 01.png."""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np

from tangent_train.files import csv_text, write_text
from tangent_train.geometry import PanoramaPose
from tangent_train.heads.scales import frame_scales, pose_scales
from tangent_train.io.pixel_files import read_depth_m
from tangent_train.rendering.resampling import resize

COLUMNS = (
    *("smooth error %", "step before %", "step %", "ratio error %", "unit error %"),
    "ratio error of frames %",
)


def main() -> None:
    """Print and write the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("depth", type=Path, nargs=2, help="distances in millimeters")
    parser.add_argument(
        "--shift", type=float, nargs=3, help="position of the first: x ahead, y left"
    )
    parser.add_argument("--draws", type=int, default=20)
    parser.add_argument("--output", type=Path, default=Path("depth_across.csv"))
    given = parser.parse_args()
    maps = np.stack(
        [resize(read_depth_m(path, 1000), (128, 256), "nearest") for path in given.depth]
    )
    axes, rng, rows = np.diag([1.0, -1, 1]), np.random.default_rng(0), []
    poses = [PanoramaPose(axes, given.shift), PanoramaPose(axes, np.zeros(3))]
    for error in (0, 0.05, 0.1, 0.2):
        found = []
        for _ in range(given.draws):
            true, coarse = np.exp(rng.normal(0, 0.4, 2)), rng.normal(0, error, (2, 8, 16))
            smooth = [cv2.resize(one, (256, 128), interpolation=cv2.INTER_CUBIC) for one in coarse]
            seen = maps / true[:, None, None] * np.exp(smooth)
            scales, steps = pose_scales(seen, poses)
            logs, of_frames = np.log(scales / true), np.log(frame_scales(seen)[0] / true)
            found.append((*steps, np.ptp(logs), abs(logs.mean()), np.ptp(of_frames)))
        rows.append(
            [f"{100 * error:g}", *(float(f"{100 * v:.2g}") for v in np.median(found, axis=0))]
        )
    text = csv_text(COLUMNS, rows)
    print(text)
    write_text(given.output, text)


if __name__ == "__main__":
    main()
