"""Keypoints and matches of panoramas as COLMAP reads them: text files, or a database.

COLMAP's pixels have their corners at whole numbers: the centre of the first pixel is (½, ½). Its
scale is that of the Gaussian, half of OpenCV's size; orientations turn from right to down.
Panoramas have its camera model EQUIRECTANGULAR, whose parameters are their size.
"""

from __future__ import annotations

from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from tangent_train.errors import SettingError
from tangent_train.files import atomic_path, write_text
from tangent_train.keypoints.motion_search import colmap, rigid_matrix

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from numpy.typing import NDArray

    from tangent_train.keypoints.spherical import SphericalKeypoints
    from tangent_train.keypoints.two_view import TwoView

__all__ = ["ColmapImage", "ColmapPair", "write_colmap_database", "write_colmap_text"]

_SIFT = 128
MATCHES = "matches.txt"


class ColmapImage(NamedTuple):
    """A panorama and its keypoints.

    Attributes:
        name: File name relative to COLMAP's image folder, with ``/`` between folders.
        shape: ``(H, W)`` of the file.
        keypoints: Keypoints in the frame of the panorama.
    """

    name: str
    shape: tuple[int, int]
    keypoints: SphericalKeypoints


class ColmapPair(NamedTuple):
    """Matches of two panoramas.

    Attributes:
        left: Name of the left one.
        right: Name of the right one.
        matches: ``(m, 2)`` putative matches, indices of keypoints.
        two_view: The geometry of the m matches, where it was estimated.
    """

    left: str
    right: str
    matches: NDArray[np.integer]
    two_view: TwoView | None = None


def write_colmap_text(
    folder: Path,
    images: Sequence[ColmapImage],
    pairs: Sequence[ColmapPair] = (),
    *,
    overwrite: bool = False,
) -> list[Path]:
    """Write ``<image>.txt`` for ``colmap feature_importer`` and, for pairs, a list of matches.

    A file of features has the line ``N 128`` and for every keypoint ``x y scale orientation`` and
    128 numbers from 0 to 255. ``matches.txt`` is for ``colmap matches_importer --match_type raw``:
    for every pair the two names, a line ``i j`` for every putative match, and an empty line.

    Args:
        folder: Where to; created.
        images: Panoramas with SIFT keypoints.
        pairs: Their matches.
        overwrite: Whether files of these names may be replaced.

    Returns:
        The files.

    Raises:
        SettingError: There are such files already, keypoints are not SIFT's, names or matches
            cannot be used.
    """
    known = _checked(images, pairs)
    _no_spaces(pairs)
    files = {folder / f"{image.name}.txt": image for image in images}
    matches = [folder / MATCHES] if pairs else []
    if len({*files, *matches}) < len(images) + len(matches):
        raise SettingError("images", found=f"one named {MATCHES[:-4]}", expected="another name")
    _check_new([*files, *matches], overwrite=overwrite)
    for image in images:  # all before the first is written
        _sift_bytes(image)
    for path, image in files.items():
        write_text(path, _features(image))
    for path in matches:
        write_text(path, "".join(_match_list(pair, known) for pair in pairs))
    return [*files, *matches]


def write_colmap_database(
    path: Path,
    images: Sequence[ColmapImage],
    pairs: Sequence[ColmapPair] = (),
    *,
    overwrite: bool = False,
) -> None:
    """Write a COLMAP database: cameras, images, keypoints, matches and two-view geometries.

    There is one camera for each size of panorama. SIFT descriptors are written, too; COLMAP knows
    no type for ORB's and AKAZE's, whose matches are all it needs.

    Args:
        path: The database; its folder is created.
        images: Panoramas and their keypoints.
        pairs: Their matches; each pair of panoramas once.
        overwrite: Whether an existing file may be replaced.

    Raises:
        SettingError: There is such a file already, names or matches cannot be used, or pycolmap is
            missing.
    """
    _checked(images, pairs)
    _check_new([path], overwrite=overwrite)
    pycolmap = colmap()
    with atomic_path(path) as temporary:
        database = pycolmap.Database.open(temporary)
        try:
            cameras = _write_cameras(database, images)
            ids = {image.name: _write_image(database, image, cameras) for image in images}
            for pair in pairs:
                _write_pair(database, pair, ids[pair.left], ids[pair.right])
        finally:
            database.close()


def _write_cameras(database: Any, images: Iterable[ColmapImage]) -> dict[tuple[int, int], Any]:
    """One camera, and a rig that consists of it, for each size of panorama."""
    pycolmap = colmap()
    cameras = {}
    for number, shape in enumerate(dict.fromkeys(image.shape for image in images), 1):
        height, width = shape
        # The focal length is one of other models.
        camera = pycolmap.Camera.create_from_model_name(
            number, "EQUIRECTANGULAR", 1.0, width, height
        )
        database.write_camera(camera, use_camera_id=True)
        rig = pycolmap.Rig(rig_id=number)
        rig.add_ref_sensor(camera.sensor_id)
        database.write_rig(rig, use_rig_id=True)
        cameras[shape] = camera
    return cameras


def _write_image(database: Any, image: ColmapImage, cameras: Mapping[tuple[int, int], Any]) -> int:
    pycolmap = colmap()
    camera_id = cameras[image.shape].camera_id
    image_id: int = database.write_image(pycolmap.Image(name=image.name, camera_id=camera_id))
    frame = pycolmap.Frame(rig_id=camera_id)
    frame.add_data_id(pycolmap.Image(camera_id=camera_id, image_id=image_id).data_id)
    database.write_frame(frame)
    database.write_keypoints(image_id, _shapes(image).astype(np.float32))
    if image.keypoints.descriptors.shape[1] == _SIFT:
        kind = pycolmap.FeatureExtractorType.SIFT
        database.write_descriptors(image_id, pycolmap.FeatureDescriptors(kind, _sift_bytes(image)))
    return image_id


def _write_pair(database: Any, pair: ColmapPair, left_id: int, right_id: int) -> None:
    pycolmap = colmap()
    matches = np.asarray(pair.matches, np.uint32).reshape(-1, 2)
    database.write_matches(left_id, right_id, matches)
    found = pair.two_view
    if found is None:
        return
    geometry = pycolmap.TwoViewGeometry()
    kinds = pycolmap.TwoViewGeometryConfiguration
    geometry.config = {
        "general": kinds.CALIBRATED,
        "rotation": kinds.PANORAMIC,
        "none": kinds.DEGENERATE,
    }[found.kind]
    geometry.inlier_matches = matches[found.inliers]
    if found.rotation is not None:
        motion = rigid_matrix(found.rotation, found.translation)
        geometry.cam2_from_cam1 = pycolmap.Rigid3d(motion)
    if found.essential is not None:
        geometry.E = pycolmap.essential_matrix_from_pose(geometry.cam2_from_cam1)
    database.write_two_view_geometry(left_id, right_id, geometry)


def _shapes(image: ColmapImage) -> NDArray[np.float64]:
    """``(n, 4)`` x, y, scale and orientation as COLMAP has them."""
    keypoints, shape = image.keypoints, image.shape
    return np.column_stack(
        [
            keypoints.equirect_pixels(shape) + 0.5,
            keypoints.equirect_sizes(shape) / 2,
            keypoints.equirect_angles(shape),
        ]
    )


def _sift_bytes(image: ColmapImage) -> NDArray[np.uint8]:
    descriptors = image.keypoints.descriptors
    if descriptors.shape[1] != _SIFT:
        raise SettingError(
            f"COLMAP's text for {image.name}",
            found=f"descriptors of {descriptors.shape[1]} {descriptors.dtype} numbers",
            expected=f"SIFT's {_SIFT}",
            remedy="Use detector=sift, or export a database, which works without descriptors.",
        )
    return np.rint(descriptors).clip(0, 255).astype(np.uint8)


def _features(image: ColmapImage) -> str:
    shapes, descriptors = _shapes(image).tolist(), _sift_bytes(image).tolist()
    lines = [
        f"{x:.4f} {y:.4f} {scale:.4f} {angle:.5f} {' '.join(map(str, descriptor))}"
        for (x, y, scale, angle), descriptor in zip(shapes, descriptors, strict=True)
    ]
    return "\n".join([f"{len(lines)} {_SIFT}", *lines, ""])


def _match_list(pair: ColmapPair, known: Mapping[str, ColmapImage]) -> str:
    names = known[pair.left].name, known[pair.right].name
    lines = [f"{i} {j}" for i, j in np.asarray(pair.matches).reshape(-1, 2).tolist()]
    return "\n".join([" ".join(names), *lines, "", ""])


def _checked(images: Sequence[ColmapImage], pairs: Sequence[ColmapPair]) -> dict[str, ColmapImage]:
    known = {image.name: image for image in images}
    if len(known) < len(images):
        raise SettingError("images", found="the same name twice", expected="unique names")
    for name in known:
        path = PurePosixPath(name)
        if not path.name or path.is_absolute() or ".." in path.parts or not name.isprintable():
            raise SettingError("image", found=repr(name), expected="a relative file name")
    for pair in pairs:
        _check_pair(pair, known)
    once = {frozenset((pair.left, pair.right)) for pair in pairs}
    if len(once) < len(pairs):
        raise SettingError("pairs", found="the same pair twice", expected="each pair once")
    return known


def _check_pair(pair: ColmapPair, known: Mapping[str, ColmapImage]) -> None:
    subject = f"pair {pair.left}, {pair.right}"
    if pair.left == pair.right or not {pair.left, pair.right} <= set(known):
        raise SettingError(subject, found="other names", expected="two of the images")
    matches = np.asarray(pair.matches).reshape(-1, 2)
    counts = [len(known[name].keypoints) for name in (pair.left, pair.right)]
    if len(matches) and not ((matches >= 0) & (matches < counts)).all():
        raise SettingError(
            subject, found="matches of keypoints that are not there", expected=f"below {counts}"
        )
    if pair.two_view is not None and len(pair.two_view.inliers) != len(matches):
        raise SettingError(
            subject,
            found=f"the geometry of {len(pair.two_view.inliers)} matches",
            expected=f"that of its {len(matches)}",
        )


def _no_spaces(pairs: Iterable[ColmapPair]) -> None:
    for name in (name for pair in pairs for name in (pair.left, pair.right)):
        if any(character.isspace() for character in name):
            raise SettingError(
                "image",
                found=repr(name),
                expected="a name without spaces, which COLMAP's lists of matches cannot hold",
                remedy="Export a database, which takes any name, or rename the file.",
            )


def _check_new(paths: Iterable[Path], *, overwrite: bool) -> None:
    for path in paths:
        if path.is_dir() or (path.exists() and not overwrite):
            raise SettingError(
                "output",
                found=f"{path}, which is there already",
                expected="a name that is free",
                remedy="Give another one, or remove it.",
            )
