"""Homes in ZInD's format, and what their cameras see by brute force."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from tangent_train.geometry import equirect_directions
from tests.datamodules.rays import hit_distances

KINDS = {"doors": 4, "windows": 5, "openings": 0}
"""Fixtures and their labels; 1 is ceiling, 2 floor, 3 wall."""

SCALE, METERS = 0.4, 3.0  # units of the floor in a camera height, meters in such a unit

Fixtures = dict[str, list[tuple[tuple[float, float], tuple[float, float], tuple[float, float]]]]
"""By kind: both ends, then bottom and top."""


@dataclass
class Room:
    """A room in the plane of its floor, in camera heights; z is 0 at the camera."""

    vertices: Sequence[tuple[float, float]]
    fixtures: Fixtures = field(default_factory=dict)
    ceiling_z: float = 0.6


@dataclass
class Camera:
    """A panorama: where it is in the plane of the floor, and its rotation there."""

    name: str
    xy: tuple[float, float] = (0.0, 0.0)
    rotation_deg: float = 0.0
    is_inside: bool = True

    def local(self, points: Any) -> NDArray[np.float64]:
        """Points of the floor in the frame of the camera."""
        angle = math.radians(self.rotation_deg)
        rotation = np.array(
            [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]
        )
        local: NDArray[np.float64] = (np.array(points, float) - self.xy) @ rotation
        return local

    def layout(self, room: Room) -> dict[str, Any]:
        """A layout as in the file."""
        fixtures = {
            kind: [
                point
                for start, end, heights in room.fixtures.get(kind, ())
                for point in (*self.local([start, end]).tolist(), list(heights))
            ]
            for kind in KINDS
        }
        return {"vertices": self.local(room.vertices).tolist(), **fixtures, "internal": []}

    def record(self, room: Room, image_path: str) -> dict[str, Any]:
        """Return the record of the panorama in the file."""
        layout = self.layout(room)
        seen = {"layout_visible": layout} if self.is_inside else {}
        return {
            "is_inside": self.is_inside,
            "camera_height": 1,
            "ceiling_height": 1 + room.ceiling_z,
            "image_path": image_path,
            "layout_raw": layout,
            **seen,
            "floor_plan_transformation": {
                "translation": [SCALE * xy for xy in self.xy],
                "rotation": self.rotation_deg,
                "scale": SCALE,
            },
        }


def write_home(
    folder: Path, rooms: Sequence[tuple[Room, Sequence[Camera]]], rows: int = 64
) -> Path:
    """One home of one floor; returns its ``zind_data.json``.

    Args:
        folder: Folder of the home.
        rooms: Complete rooms of one part each, and the panoramas of each.
        rows: Rows of the pictures, which are noise.
    """
    rng = np.random.default_rng(0)
    floor: dict[str, Any] = {}
    (folder / "panos").mkdir(parents=True)
    for number, (room, cameras) in enumerate(rooms, start=1):
        panoramas: dict[str, Any] = {}
        for camera in cameras:
            path = f"panos/floor_01_partial_room_{number:02}_{camera.name}.jpg"
            pixels = rng.integers(0, 256, (rows, 2 * rows, 3), np.uint8)
            Image.fromarray(pixels).save(folder / path, quality=95)
            panoramas[camera.name] = camera.record(room, path)
        floor[f"complete_room_{number:02}"] = {f"partial_room_{number:02}": panoramas}
    file = folder / "zind_data.json"
    content = {
        "scale_meters_per_coordinate": {"floor_01": METERS},
        "merger": {"floor_01": floor},
    }
    file.write_text(json.dumps(content))
    return file


SQUARE = Room(
    [(-2, -1.5), (2, -1.5), (2, 1.5), (-2, 1.5)],
    {
        "doors": [((2, 0), (2, 0.8), (-1, 0.4))],
        "windows": [((-1, 1.5), (0.5, 1.5), (-0.4, 0.4))],
    },
)
CORNERED = Room(
    [(0, 0), (5, 0), (5, 2), (2, 2), (2, 6), (0, 6)],
    {
        "doors": [((0, 0), (0.9, 0), (-1, 0.5)), ((2, 5), (2, 5.9), (-1, 0.4))],
        "windows": [((5, 0.5), (5, 2), (-0.2, 0.3))],
        "openings": [((0.2, 6), (1.7, 6), (-1, 0.7))],
    },
)


def write_homes(root: Path, homes: Sequence[str] = ("000",), rows: int = 64) -> Path:
    """Homes of four rooms and seven panoramas each, one of them outside of its room."""
    for home in homes:
        cameras = [
            (SQUARE, [Camera("pano_1"), Camera("pano_2", (1.9, 1.2), 75)]),
            (CORNERED, [Camera("pano_3", (1, 1)), Camera("pano_5", (0.6, 4), -140)]),
            (SQUARE, [Camera("pano_4", (-1, 0.3), 10)]),
            (SQUARE, [Camera("pano_6", (0.2, 0.1), 200)]),
            (SQUARE, [Camera("pano_7", (7, 0), is_inside=False)]),
        ]
        write_home(root / home, cameras, rows)
    return root


def brute_force_labels(
    layout: Mapping[str, Any], ceiling_z: float, shape: tuple[int, int]
) -> NDArray[np.uint8]:
    """Labels by the nearest of all triangles that every ray meets (Möller and Trumbore).

    Args:
        layout: As in the file.
        ceiling_z: Height of the ceiling above the camera; the floor is 1 below it.
        shape: Rows and columns of the panorama.
    """
    x, y, z = np.moveaxis(equirect_directions(shape), -1, 0)
    rays = np.stack([-y, x, z], axis=-1).reshape(-1, 3)  # x to the left, y to the middle
    far = 1e3
    corners = [(-far, -far), (far, -far), (far, far), (-far, far)]
    quads = [(1, [(*c, ceiling_z) for c in corners]), (2, [(*c, -1.0) for c in corners])]
    vertices = layout["vertices"]
    for a, b in zip(vertices, [*vertices[1:], vertices[0]], strict=True):
        quads.append((3, [(*a, -9.0), (*b, -9.0), (*b, 9.0), (*a, 9.0)]))
    for kind, label in KINDS.items():
        points = np.array(layout[kind]).reshape(-1, 3, 2) * (1 - 1e-9)  # before the wall
        quads += [
            (label, [(*a, low), (*b, low), (*b, high), (*a, high)]) for a, b, (low, high) in points
        ]
    triangles = [(*corner[:1], *corner[k : k + 2]) for _, corner in quads for k in (1, 2)]
    nearest = hit_distances(0.0, rays, triangles).argmin(axis=1)
    return np.array([label for label, _ in quads], np.uint8)[nearest // 2].reshape(shape)
