"""Read poses of panoramas, and points, that COLMAP estimated."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tangent_train.errors import DataError
from tangent_train.geometry import PanoramaPose, to_right_handed
from tangent_train.io.camera_files import RIG_FILE, RigFile, read_poses, read_rig
from tangent_train.keypoints.two_view import colmap


def poses_from(path: Path, project: Path | None = None) -> dict[str, PanoramaPose]:
    """Read poses of panoramas, by file, from a JSON file or a sparse COLMAP model.

    Args:
        path: File of `write_poses`, or folder of the model.
        project: Folder with the rig of the model; None for two folders above it.

    Raises:
        DataError: A file cannot be read, or the model contains no panorama of the project.
        SettingError: pycolmap is missing.
    """
    if path.is_file():
        return read_poses(path)
    return panorama_poses(path, read_rig((project or path.absolute().parent.parent) / RIG_FILE))


def model_points(model: Path) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Return the points ``(n, 3)`` of a sparse COLMAP model, and their RGB colors."""
    points = colmap().Reconstruction(model).points3D.values()
    xyz = np.array([point.xyz for point in points]).reshape(-1, 3)
    return xyz, np.array([point.color for point in points], np.uint8).reshape(-1, 3)


def panorama_poses(model: Path, rig: RigFile) -> dict[str, PanoramaPose]:
    """Compute poses of panoramas from the poses of their tangent images in a COLMAP model.

    Args:
        model: Folder of a sparse COLMAP model, binary or text.
        rig: Rig of the project from which the model was reconstructed.

    Returns:
        Pose of each panorama in the model, by file, in the model's world and units.

    Raises:
        DataError: The model cannot be read, or it contains no panorama of the project.
        SettingError: pycolmap is missing.
    """
    pycolmap = colmap()
    try:
        images = pycolmap.Reconstruction(model).images.values()
    except (ValueError, RuntimeError, OSError, IndexError, KeyError) as error:
        expected = "a folder with a sparse COLMAP model, such as sparse/0"
        raise DataError(model, found=error, expected=expected) from error
    poses: dict[str, PanoramaPose] = {}
    for image in sorted((image for image in images if image.has_pose), key=lambda i: i.name):
        folder, _, name = image.name.rpartition("/")
        prefix = f"{folder}/"
        if prefix in rig.world_from_camera and name in rig.panoramas:
            camera_from_world = image.cam_from_world().rotation.matrix()
            axes = to_right_handed(camera_from_world.T @ rig.world_from_camera[prefix].T)
            pose = PanoramaPose(axes, image.projection_center())
            poses.setdefault(rig.panoramas[name], pose)
    if not poses:
        raise DataError(model, found="none of the panoramas", expected="a model of this project")
    return dict(sorted(poses.items()))
