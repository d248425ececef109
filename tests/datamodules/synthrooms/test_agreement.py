"""Pictures of one room agree with each other, read from their files by the stated formulas."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from datamodules.synthrooms.generate import generate_rooms, plan_rooms
from datamodules.synthrooms.settings import RoomSettings
from tangent_train.geometry import equirect_directions, lonlat_to_equirect, xyz_to_lonlat
from tests.datamodules.data_files import read_png

TRUE = RoomSettings(seed=6, rooms={"2": 1}, height=256, views_per_camera=3, view_size=128)


class Shot(NamedTuple):
    """A picture read back from its files."""

    rgb: NDArray[Any]
    depth_m: NDArray[Any]
    label: NDArray[Any]
    pose: dict[str, Any]
    points: NDArray[Any]


def read(file: Path) -> Shot:
    """Read by the formulas in the generator's documentation, and by nothing else of it."""
    images = {}
    for kind in ("rgb", "depth", "semantic"):
        path = file.parents[1] / kind / file.name.replace("_rgb.", f"_{kind}.")
        images[kind] = read_png(path)
    pose_file = file.parents[1] / "pose" / file.name.replace("_rgb.png", "_pose.json")
    pose = json.loads(pose_file.read_text())
    depth = np.where(images["depth"] == 65535, np.nan, images["depth"] / 512)
    blue, green, red = np.moveaxis(images["semantic"].astype(int), -1, 0)
    R = np.array(pose["camera_rt_matrix"])[:, :3]
    if pose["frame_num"] == "equirectangular":
        x, y, z = np.moveaxis(equirect_directions(depth.shape), -1, 0)
        rays = np.stack([y, -z, x], axis=-1)
    else:
        K = np.array(pose["camera_k_matrix"]) - np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
        size = depth.shape
        pixels = np.stack([*np.meshgrid(np.arange(size[1]), np.arange(size[0])), np.ones(size)], -1)
        rays = pixels @ np.linalg.inv(K).T
    points = np.array(pose["camera_location"]) + depth[..., None] * (rays @ R)
    return Shot(images["rgb"][..., ::-1], depth, red * 65536 + green * 256 + blue, pose, points)


def panorama_pixels(points: NDArray[Any], panorama: Shot) -> NDArray[Any]:
    """Where points of the room appear in a panorama, ``(..., 2)`` column and row."""
    rt = np.array(panorama.pose["camera_rt_matrix"])
    right, down, forward = np.moveaxis(points @ rt[:, :3].T + rt[:, 3], -1, 0)
    sphere = np.stack([forward, right, -down], axis=-1)
    return lonlat_to_equirect(xyz_to_lonlat(sphere), panorama.depth_m.shape)


def at_nearest(image: NDArray[Any], pixels: NDArray[Any]) -> NDArray[Any]:
    column, row = np.rint(pixels).astype(int).T
    return image[np.clip(row, 0, len(image) - 1), column % image.shape[1]]


@pytest.fixture(scope="module")
def shots(tmp_path_factory: pytest.TempPathFactory) -> list[Shot]:
    """A panorama and views of the same camera."""
    root = tmp_path_factory.mktemp("data") / "true"
    generate_rooms(root, TRUE, workers=0)
    (plan,) = plan_rooms(TRUE)
    frames = ("equirectangular", "0", "1", "2")
    return [read(root / plan.file(plan.cameras[0], frame, "rgb")) for frame in frames]


def away_from_edges(panorama: Shot) -> NDArray[Any]:
    """Pixels whose neighbours within two pixels have the same label and about the same colour."""
    rgb = np.ascontiguousarray(panorama.rgb)
    label = panorama.label.astype(np.float32)
    kernel = np.ones((5, 5), np.uint8)
    same = cv2.dilate(label, kernel) == cv2.erode(label, kernel)
    contrast = cv2.dilate(rgb, kernel).astype(int) - cv2.erode(rgb, kernel)
    return (same & (contrast.max(axis=-1) < 80)).astype(bool)


def test_views_show_what_the_panorama_shows(shots: list[Shot]) -> None:
    panorama, *views = shots
    calm = away_from_edges(panorama)
    compared = 0
    for view in views:
        seen = ~np.isnan(view.depth_m)
        pixels = panorama_pixels(view.points[seen], panorama)
        inner = at_nearest(calm, pixels)
        same = at_nearest(panorama.label, pixels) == view.label[seen]
        assert same[inner].mean() > 0.99
        x, y = pixels[inner].astype(np.float32).T[..., None]
        shown = cv2.remap(panorama.rgb, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
        error = np.mean((shown[:, 0].astype(float) - view.rgb[seen][inner]) ** 2)
        assert 10 * np.log10(255**2 / error) > 28
        compared += int(inner.sum())
    assert compared > 10_000
