"""Projects for Nerfstudio: ``transforms.json``, z-depth and a point cloud.

Camera axes are those of OpenGL: x right, y up, z back. Principal points count from pixel corners.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tangent_train.console import print_text
from tangent_train.errors import listed
from tangent_train.files import write_bytes, write_text
from tangent_train.geometry import PanoramaPose, ray_lengths
from tangent_train.io.camera_files import View
from tangent_train.io.pixel_files import read_depth_m, read_pixels, read_rgb, write_depth_m
from tangent_train.rendering import equirect_to_tangent

TRANSFORMS_FILE = "transforms.json"
POINTS_FILE = "sparse_pc.ply"
UNITS_PER_M = 1000
"""Units of depth files per meter, or per unit of the poses: Nerfstudio's default."""

_MOST_POINTS = 500_000
_TO_OPENGL = (1, -1, -1)


def write_z_depth(distance: NDArray[np.floating], files: Mapping[Path, View]) -> None:
    """Write the z-depth of views as 16-bit PNG files, by the nearest pixels of a panorama.

    Args:
        distance: ``(H, W)`` distances from the center, 0 where unknown.
        files: View of each file.
    """
    for path, (grid, face) in files.items():
        (seen,) = equirect_to_tangent(distance, grid, [face], "nearest")
        write_depth_m(path, seen / ray_lengths(grid.camera_matrix, grid.size), UNITS_PER_M)


def write_transforms(
    folder: Path, rig: Mapping[str, View], poses: Mapping[str, PanoramaPose | None], points: Any
) -> None:
    """Write ``transforms.json`` and ``sparse_pc.ply`` of a project.

    Args:
        folder: Folder with ``images``, ``masks`` and, with z-depth, ``depths``.
        rig: View of each camera, by the prefix of its images' names.
        poses: Pose of each panorama, by the rest of its images' names; those without are left out.
        points: ``(n, 3)`` points and their RGB colors, or None; with z-depth, its points are taken.
    """
    if missing := [name for name, pose in poses.items() if pose is None]:
        print_text(f"Without a pose, and left out: {listed(missing)}.")
    frames = {p + n: (rig[p], pose) for n, pose in poses.items() if pose is not None for p in rig}
    has_depth = bool(frames) and (folder / "depths").is_dir()
    entries = [_frame(name, *of_frame, has_depth=has_depth) for name, of_frame in frames.items()]
    if has_depth:
        share = _MOST_POINTS / sum(entry["w"] * entry["h"] for entry in entries)
        parts = [_points(folder, name, share, *of_frame) for name, of_frame in frames.items()]
        points = map(np.concatenate, zip(*parts, strict=True))
    content: dict[str, Any] = {"camera_model": "OPENCV", "frames": entries}
    if points is not None:
        from trimesh import PointCloud  # half a second

        cloud: Any = PointCloud(*points).export(file_type="ply")
        write_bytes(folder / POINTS_FILE, cloud)
        content["ply_file_path"] = POINTS_FILE
    write_text(folder / TRANSFORMS_FILE, json.dumps(content, indent=1) + "\n")


def _frame(name: str, view: View, pose: PanoramaPose, *, has_depth: bool) -> dict[str, Any]:
    (grid, face), matrix = view, np.eye(4)
    matrix[:3, :3] = pose.world_from_panorama @ grid.world_from_camera[face] * _TO_OPENGL
    matrix[:3, 3] = pose.location_m
    (fx, _, cx), (_, fy, cy), _ = grid.camera_matrix.tolist()
    camera = {"w": grid.size[1], "h": grid.size[0], "fl_x": fx, "fl_y": fy}
    files = {"file_path": f"images/{name}", "mask_path": f"masks/{name}.png"}
    files |= {"depth_file_path": f"depths/{name}.png"} if has_depth else {}
    center = {"cx": cx + 0.5, "cy": cy + 0.5}
    return {**files, **camera, **center, "transform_matrix": matrix.tolist()}


def _points(
    folder: Path, name: str, share: float, view: View, pose: PanoramaPose
) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Return points of random pixels that count and have z-depth, and their colors."""
    grid, face = view
    depth = read_depth_m(folder / "depths" / f"{name}.png", UNITS_PER_M)
    distance = depth * ray_lengths(grid.camera_matrix, grid.size)
    is_known = read_pixels(folder / "masks" / f"{name}.png", indices=True) * distance > 0
    chosen = is_known & (np.random.default_rng(0).random(grid.size) < share)
    points = pose.points_m(grid.directions([face])[0][chosen], distance[chosen])
    return points, read_rgb(folder / "images" / name)[chosen]
