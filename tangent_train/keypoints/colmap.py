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
from tangent_train.io.camera_files import LOCATION_FILE, RIG_FILE, read_poses, read_rig
from tangent_train.keypoints.features import SphericalKeypoints
from tangent_train.keypoints.two_view import TwoView, colmap, rigid_matrix

Points = NDArray[np.float64]


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
