"""Scales of frames of straight walks through synthetic rooms: python -m studies.depth_frames."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from datamodules.synthrooms.furniture import build_room, draw_room_type
from datamodules.synthrooms.render import RayScene, even_directions
from tangent_train.files import csv_text, write_text
from tangent_train.geometry import equirect_directions
from tangent_train.heads.scales import frame_scales

SHAPE = 64, 128
CLEAR_M = 0.3
COLUMNS = ("step m", "smooth error %", "largest ratio error %", "ratio error of neighbors %")


def walk(rng: np.random.Generator, step_m: float, length_m: float) -> NDArray[np.float64]:
    """Return distances ``(n, H, W)`` along a straight walk through a furnished room."""
    rays = equirect_directions(SHAPE).reshape(-1, 3).astype(np.float32)
    while True:
        scene = RayScene(build_room(rng, draw_room_type(rng)))
        for x0, y0, x1, y1 in scene.room.plan.floors:
            start, angle = np.array([*rng.uniform((x0, y0), (x1, y1)), 1.5]), rng.uniform(0, 6.3)
            ahead = np.array([np.cos(angle), np.sin(angle), 0])
            path = [start + ahead * t for t in np.arange(0, length_m + 1e-9, step_m)]
            nearest = [scene.cast(p, even_directions(96)).distance.min() for p in path]
            free = scene.cast(start, ahead[None].astype(np.float32)).distance[0]
            if min(nearest) > CLEAR_M and free > length_m + CLEAR_M:
                return np.stack([scene.cast(p, rays).distance.reshape(SHAPE) for p in path])


def errors(rng: np.random.Generator, step_m: float, smooth: float) -> tuple[float, float]:
    """Return the largest ratio error of the scales of a walk, and the median one of neighbors."""
    distances = walk(rng, step_m, 2.0)
    true: Any = np.exp(rng.normal(0, 0.4, len(distances)))
    coarse = rng.normal(0, smooth, (len(distances), 8, 16))
    of_network = [cv2.resize(c, SHAPE[::-1], interpolation=cv2.INTER_CUBIC) for c in coarse]
    found, _ = frame_scales(distances / true[:, None, None] * np.exp(of_network))
    logs = np.log(found / true)
    return float(np.ptp(logs)), float(np.median(np.abs(np.diff(logs))))


def main() -> None:
    """Print and write the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rooms", type=int, default=12)
    parser.add_argument("--output", type=Path, default=Path("depth_frames.csv"))
    given, rows = parser.parse_args(), []
    for step_m in (0.05, 0.1, 0.2, 0.3, 0.5, 1.0):
        for smooth in (0, 0.1):
            seeds = range(given.rooms)
            found = [errors(np.random.default_rng(seed), step_m, smooth) for seed in seeds]
            means = (round(100 * v, 1) for v in np.mean(found, axis=0))
            rows.append([step_m, f"{100 * smooth:g}", *means])
    text = csv_text(COLUMNS, rows)
    print(text)
    write_text(given.output, text)


if __name__ == "__main__":
    main()
