"""A sparse COLMAP model of the images of panoramas, with points at known places."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tangent_train.geometry import PanoramaPose, to_right_handed
from tangent_train.geometry.perspective import perspective_grid
from tangent_train.io.camera_files import RIG_FILE, View, read_rig, write_rig


def write_model(
    project: Path, poses: Mapping[str, PanoramaPose], points: Mapping[str, Any]
) -> Path:
    """Write a project of two views, to the right and to the left, and its model.

    Args:
        project: Folder of the project.
        poses: Pose of each panorama by file.
        points: Points ``(n, 3)`` of each panorama. Either view observes two thirds of them.

    Returns:
        Folder of the model.
    """
    pycolmap = pytest.importorskip("pycolmap")
    grid, names = (
        perspective_grid([90, -90], 0, 90, 64),
        {f"{k}.png": f for k, f in enumerate(poses)},
    )
    views: dict[str, View] = {"right/": (grid, 0), "left/": (grid, 1)}
    write_rig(project / RIG_FILE, views, names)
    model, rig = pycolmap.Reconstruction(), read_rig(project / RIG_FILE)
    for number in (1, 2):
        camera = pycolmap.Camera.create_from_model_name(number, "PINHOLE", 32, 64, 64)
        model.add_camera_with_trivial_rig(camera)
    for name, file in names.items():
        axes, xyz = to_right_handed(poses[file].world_from_panorama), points[file]
        tracks: dict[int, list[Any]] = {}
        parts = range(2 * len(xyz) // 3), range(len(xyz) // 3, len(xyz))
        for number, prefix in enumerate(views):
            from_world = (axes @ rig.world_from_camera[prefix]).T
            motion = np.column_stack([from_world, -from_world @ poses[file].location_m])
            image_id = len(model.images) + 1
            given = {"camera_id": number + 1, "image_id": image_id}
            pixels = np.zeros((len(parts[number]), 2))
            image = pycolmap.Image(name=prefix + name, keypoints=pixels, **given)
            model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(motion))
            for index, point in enumerate(parts[number]):
                element = pycolmap.TrackElement(image_id, index)
                tracks.setdefault(point, []).append(element)
        for point, elements in tracks.items():
            model.add_point3D(xyz[point], pycolmap.Track(elements), np.zeros(3, np.uint8))
    folder = project / "sparse" / "0"
    folder.mkdir(parents=True)
    model.write(folder)
    return folder
