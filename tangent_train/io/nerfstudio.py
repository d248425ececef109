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

from tangent_train.files import write_text
from tangent_train.geometry import PanoramaPose, ray_lengths
from tangent_train.io.camera_files import View
from tangent_train.io.pixel_files import read_depth_m, read_pixels, read_rgb, write_depth_m
from tangent_train.io.point_clouds import write_points
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
        files: View of each file; its suffix is replaced.
    """
    for path, (grid, face) in files.items():
        (seen,) = equirect_to_tangent(distance, grid, [face], "nearest")
        z_depth = seen / ray_lengths(grid.camera_matrix, grid.size)
        write_depth_m(path.with_suffix(".png"), z_depth, UNITS_PER_M)


def write_transforms(
    folder: Path, frames: Mapping[str, tuple[View, PanoramaPose]], points: Any = None
) -> None:
    """Write ``transforms.json`` and ``sparse_pc.ply`` of a project.

    Args:
        folder: Folder with ``images``, ``masks`` and, with z-depth, ``depths``.
        frames: View and pose of the panorama of each image, by its path below ``images``.
        points: ``(n, 3)`` points and their RGB colors; None for those of the z-depth, if any.
    """
    entries = [_frame(name, *of_frame) for name, of_frame in frames.items()]
    if entries and (folder / "depths").is_dir():
        for entry in entries:
            name = Path("depths", *Path(entry["file_path"]).parts[1:])
            entry["depth_file_path"] = name.with_suffix(".png").as_posix()
        points = _points(folder, entries)
    content = {"camera_model": "OPENCV", "frames": entries}
    if points is not None:
        write_points(folder / POINTS_FILE, *points)
        content["ply_file_path"] = POINTS_FILE
    write_text(folder / TRANSFORMS_FILE, json.dumps(content, indent=1) + "\n")


def _frame(name: str, view: View, pose: PanoramaPose) -> dict[str, Any]:
    (grid, face), matrix = view, np.eye(4)
    matrix[:3, :3] = pose.world_from_panorama @ grid.world_from_camera[face] * _TO_OPENGL
    matrix[:3, 3] = pose.location_m
    (rows, columns), focal = grid.size, 1 / grid.pitch
    return {
        "file_path": f"images/{name}",
        "mask_path": f"masks/{name}.png",
        "transform_matrix": matrix.tolist(),
    } | {"w": columns, "h": rows, "fl_x": focal, "fl_y": focal, "cx": columns / 2, "cy": rows / 2}


def _points(folder: Path, entries: list[dict[str, Any]]) -> tuple[NDArray[Any], NDArray[np.uint8]]:
    """Return points of random pixels that count and have z-depth, and their colors."""
    share = _MOST_POINTS / sum(entry["w"] * entry["h"] for entry in entries)
    rng, parts = np.random.default_rng(0), []
    for entry in entries:
        depth = read_depth_m(folder / entry["depth_file_path"], UNITS_PER_M)
        depth[read_pixels(folder / entry["mask_path"], indices=True) == 0] = 0
        rows, columns = np.nonzero((depth > 0) & (rng.random(depth.shape) < share))
        pixels = np.stack([columns + 0.5 - entry["cx"], rows + 0.5 - entry["cy"]], axis=-1)
        rays = np.insert(pixels / entry["fl_x"], 2, 1, axis=-1) * _TO_OPENGL
        matrix = np.array(entry["transform_matrix"])
        points = rays * depth[rows, columns, None] @ matrix[:3, :3].T + matrix[:3, 3]
        parts.append((points, read_rgb(folder / entry["file_path"])[rows, columns]))
    points, colors = zip(*parts, strict=True)
    return np.concatenate(points), np.concatenate(colors)
