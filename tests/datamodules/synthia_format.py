"""SYNTHIA's format, fabricated: a world painted on the sphere, seen by the four views."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from datamodules.core.files import Problems
from datamodules.synthia.generate import make_panoramas
from tests.datamodules.data_files import write_png

SIZE = (38, 64)  # the real 760×1280 by 20
FOCAL, CENTER_X, CENTER_Y = 532.740352 / 20, 32.0, 19.0
HEIGHT = 104
IDS = np.arange(16)
# Forward and right of each view: x to the front, y to the right, z up.
LOOKS = {
    "F": ((1, 0, 0), (0, 1, 0)),
    "R": ((0, 1, 0), (-1, 0, 0)),
    "B": ((-1, 0, 0), (0, -1, 0)),
    "L": ((0, -1, 0), (1, 0, 0)),
}


def sequence(root: Path, name: str) -> Path:
    return root / f"SYNTHIA-SEQS-{name}-SUMMER"


def view_rays(view: str, size: tuple[int, int] = SIZE) -> NDArray[np.float64]:
    """``(h, w, 3)`` with a forward component of 1, so that their length is distance per z-depth."""
    rows, columns = np.indices(size)
    forward, right = np.array(LOOKS[view])
    x = (columns + 0.5 - CENTER_X) / FOCAL
    y = (rows + 0.5 - CENTER_Y) / FOCAL
    rays: NDArray[np.float64] = forward + x[..., None] * right - y[..., None] * np.array([0, 0, 1])
    return rays


def project(directions: NDArray[np.float64], view: str) -> NDArray[np.float64]:
    """Column, row and forward component in a view, ``(..., 3)``."""
    forward, right = np.array(LOOKS[view])
    ahead = directions @ forward
    with np.errstate(divide="ignore", invalid="ignore"):
        x = FOCAL * (directions @ right) / ahead + CENTER_X - 0.5
        y = -FOCAL * directions[..., 2] / ahead + CENTER_Y - 0.5
    return np.stack([x, y, ahead], axis=-1)


def labels_of(directions: NDArray[np.float64], frame: int = 0) -> NDArray[np.int64]:
    """Sectors of longitude, above and below the horizon; other ones in other frames."""
    lon = np.arctan2(directions[..., 1], directions[..., 0])
    sector = np.floor((lon / (2 * np.pi) + 0.5) * 28).astype(int)
    classes: NDArray[np.int64] = IDS[(sector + 5 * (directions[..., 2] > 0) + frame) % len(IDS)]
    return classes


def rgb_of(directions: NDArray[np.float64]) -> NDArray[np.float64]:
    unit = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    return 128 + 100 * unit


def write_frame(folder: Path, number: int) -> None:
    """One frame; every other one with alpha, and with its depth in three channels."""
    for view in LOOKS:
        place = f"Stereo_Left/Omni_{view}/{number:06d}.png"
        rays = view_rays(view)
        bgr = np.rint(rgb_of(rays)[..., ::-1]).astype(np.uint8)
        ids = labels_of(rays, number).astype(np.uint16)
        labels = np.stack([ids * 0, 3000 + ids, ids], axis=-1)  # blue, green: instance; red: class
        z_depth = np.rint(500 + 10 * rays[..., 2]).astype(np.uint16)
        z_depth[:2, :3] = 0
        if number % 2:
            bgr = np.dstack([bgr, np.full(SIZE, 200, np.uint8)])
            z_depth = np.dstack([z_depth] * 3)
        write_png(folder / "RGB" / place, bgr)
        write_png(folder / "GT" / "LABELS" / place, labels)
        write_png(folder / "Depth" / place, z_depth)


def write_views(root: Path, frames: Mapping[str, int]) -> Path:
    """Sequences of so many frames; returns `root`."""
    for name, count in frames.items():
        folder = sequence(root, name)
        for number in range(count):
            write_frame(folder, number)
        camera = folder / "CameraParams" / "intrinsics.txt"
        camera.parent.mkdir(parents=True, exist_ok=True)
        camera.write_text(f"{FOCAL}\n{CENTER_X}\n{CENTER_Y}\n0.8\n")
    return root


def write_panoramas(root: Path, frames: Mapping[str, int], height: int = 32) -> Path:
    """Panoramas as if they were published, beside the views; returns `root`."""
    make_panoramas(write_views(root, frames), list(frames), Problems(), height=height)
    for name in frames:
        for file in ("manifest.json", "finished.jsonl"):
            (sequence(root, name) / "pano" / file).unlink()
    return root
