"""Write COLMAP databases with panoramas, keypoints and matches; read poses that COLMAP estimated.

In COLMAP the center of the first pixel is (½, ½). Panoramas have the camera model EQUIRECTANGULAR,
with their size as parameters.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tangent_train.errors import DataError
from tangent_train.geometry import PanoramaPose, to_right_handed
from tangent_train.io.camera_files import RIG_FILE, RigFile, read_poses, read_rig
from tangent_train.keypoints.features import SphericalKeypoints
from tangent_train.keypoints.two_view import TwoView, colmap, rigid_matrix


def add_pair(
    path: Path,
    images: Sequence[tuple[str, tuple[int, int]]],
    keypoints: tuple[SphericalKeypoints, SphericalKeypoints],
    matches: NDArray[np.integer],
    geometry: TwoView,
) -> None:
    """Add a pair of panoramas to a COLMAP database; existing entries are not changed.

    Args:
        path: Database file, created if it is missing.
        images: Left and right image: its name, relative to COLMAP's image folder, and its
            ``(H, W)``.
        keypoints: Keypoints of the left and the right image, with SIFT descriptors.
        matches: ``(m, 2)`` indices of matching keypoints.
        geometry: Two-view geometry of the m matches.

    Raises:
        SettingError: pycolmap is missing.
    """
    pycolmap = colmap()
    path.parent.mkdir(parents=True, exist_ok=True)
    with pycolmap.Database.open(path) as database, pycolmap.DatabaseTransaction(database):
        left, right = (
            _image_id(database, *image, one) for image, one in zip(images, keypoints, strict=True)
        )
        if database.exists_matches(left, right):
            return
        pairs = np.asarray(matches, np.uint32).reshape(-1, 2)
        database.write_matches(left, right, pairs)
        database.write_two_view_geometry(left, right, _geometry(pairs, geometry))


def _image_id(
    database: Any, name: str, shape: tuple[int, int], keypoints: SphericalKeypoints
) -> int:
    """Return the image of a name; add it, with its keypoints and descriptors, if missing."""
    if database.exists_image(name):
        return int(database.read_image_with_name(name).image_id)
    pycolmap = colmap()
    cameras = database.read_all_cameras()
    sizes = {(camera.height, camera.width): camera.camera_id for camera in cameras}
    number = sizes.get(shape, len(sizes) + 1)
    if shape not in sizes:  # a camera, and a rig of this camera
        # EQUIRECTANGULAR has no focal length; the argument is for other models.
        model = ("EQUIRECTANGULAR", 1.0, shape[1], shape[0])
        camera = pycolmap.Camera.create_from_model_name(number, *model)
        database.write_camera(camera, use_camera_id=True)
        rig = pycolmap.Rig(rig_id=number)
        rig.add_ref_sensor(camera.sensor_id)
        database.write_rig(rig, use_rig_id=True)
    image_id: int = database.write_image(pycolmap.Image(name=name, camera_id=number))
    frame = pycolmap.Frame(rig_id=number)
    frame.add_data_id(pycolmap.Image(camera_id=number, image_id=image_id).data_id)
    database.write_frame(frame)
    pixels = keypoints.equirect_pixels(shape) + 0.5
    database.write_keypoints(image_id, pixels.astype(np.float32))
    numbers = np.rint(keypoints.descriptors).clip(0, 255).astype(np.uint8)
    kind = pycolmap.FeatureExtractorType.SIFT
    database.write_descriptors(image_id, pycolmap.FeatureDescriptors(kind, numbers))
    return image_id


def _geometry(pairs: NDArray[np.uint32], found: TwoView) -> Any:
    pycolmap = colmap()
    geometry = pycolmap.TwoViewGeometry()
    kind = {"general": "CALIBRATED", "rotation": "PANORAMIC", "none": "DEGENERATE"}[found.kind]
    geometry.config = getattr(pycolmap.TwoViewGeometryConfiguration, kind)
    geometry.inlier_matches = pairs[found.inliers]
    if found.rotation is not None:
        motion = rigid_matrix(found.rotation, found.translation)
        geometry.cam2_from_cam1 = pycolmap.Rigid3d(motion)
    if found.translation is not None:
        geometry.E = pycolmap.essential_matrix_from_pose(geometry.cam2_from_cam1)
    return geometry


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
