"""Read poses of panoramas, and points, that COLMAP estimated."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tangent_train.errors import DataError
from tangent_train.geometry import PanoramaPose, to_right_handed
from tangent_train.io.camera_files import LOCATION_FILE, RIG_FILE, read_poses, read_rig
from tangent_train.keypoints.two_view import colmap

Points = NDArray[np.float64]


def is_model(path: Path) -> bool:
    """Return True for the folder of a sparse COLMAP model, False for other poses."""
    return path.is_dir() and not any(path.rglob("*" + LOCATION_FILE))


def model_points(model: Path) -> tuple[Points, NDArray[np.uint8]]:
    """Return the points ``(n, 3)`` of a sparse COLMAP model, and their RGB colors."""
    points = colmap().Reconstruction(model).points3D.values()
    xyz = np.array([point.xyz for point in points]).reshape(-1, 3)
    return xyz, np.array([point.color for point in points], np.uint8).reshape(-1, 3)


def poses_from(path: Path, project: Path | None = None) -> dict[str, tuple[PanoramaPose, Points]]:
    """Read poses of panoramas from a file, a folder, or a sparse COLMAP model of their images.

    Args:
        path: See `read_poses`; or folder of the model, binary or text.
        project: Folder with the rig of the model; None for two folders above it.

    Returns:
        Pose of each panorama, and the points of the model ``(n, 3)`` that it observes, by file, in
        the model's world and units.

    Raises:
        DataError: A file cannot be read, or the model contains no panorama of the project.
        SettingError: pycolmap is missing.
    """
    if not is_model(path):
        return {file: (pose, np.zeros((0, 3))) for file, pose in read_poses(path).items()}
    pycolmap, rig = colmap(), read_rig((project or path.absolute().parent.parent) / RIG_FILE)
    try:
        model = pycolmap.Reconstruction(path)
    except (ValueError, RuntimeError, OSError, IndexError, KeyError) as error:
        expected = "a folder with a sparse COLMAP model, such as sparse/0"
        raise DataError(path, found=error, expected=expected) from error
    posed = [image for image in model.images.values() if image.has_pose]
    found: dict[str, tuple[PanoramaPose, set[int]]] = {}
    for image in sorted(posed, key=lambda image: image.name):
        folder, _, name = image.name.rpartition("/")
        prefix = f"{folder}/"
        if prefix in rig.world_from_camera and name in rig.panoramas:
            camera_from_world = image.cam_from_world().rotation.matrix()
            axes = to_right_handed(camera_from_world.T @ rig.world_from_camera[prefix].T)
            pose = PanoramaPose(axes, image.projection_center())
            _, seen = found.setdefault(rig.panoramas[name], (pose, set()))
            seen.update(pixel.point3D_id for pixel in image.get_observation_points2D())
    if not found:
        raise DataError(path, found="none of the panoramas", expected="a model of this project")
    return {
        file: (pose, np.reshape([model.points3D[k].xyz for k in seen], (-1, 3)))
        for file, (pose, seen) in sorted(found.items())
    }
