"""The cameras of tangent images as files: ``cameras.json``, and COLMAP's ``rig_config.json``.

Their world is an ordinary right-handed one: x forward (to the middle column of the panorama),
y left, z up. `FLIP_Y` converts between it and the frame of `tangent_train.geometry`.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from tangent_train.errors import DataError
from tangent_train.files import parse_json, write_text
from tangent_train.geometry import FLIP_Y, PanoramaPose, TangentGrid, checked_rotation
from tangent_train.registry import Text, check_fields

CAMERAS_FILE = "cameras.json"
"""The name of the file in a folder of tangent images."""

RIG_FILE = "rig_config.json"
"""The name of the file in a project for COLMAP."""

_FORMAT = "tangent images"
_MOST_PIXELS = 2**20  # rows and columns of a panorama, which may be made of this size
_CONVENTIONS = {
    "pixels": "Pixel centres are whole numbers: (0, 0) is the centre of the upper left pixel, "
    "columns count to the right, rows down. matrix (K) takes camera coordinates to (column, row). "
    "For programs that count from pixel corners, add 0.5 to the principal point.",
    "camera_axes": "x right, y down, z forward.",
    "world_axes": "Right-handed, at the centre of the panorama: x forward, to the middle column of "
    "the panorama; y left, a quarter of the width to the left of it; z up, to the top row.",
    "world_from_camera": "Rotation matrix by rows, determinant +1: a direction d of the camera is "
    "world_from_camera · d in the world. All cameras stand at the origin.",
    "icosahedron_rotation": "Rotation of the icosahedron as a whole, in the world axes; null for "
    "none.",
    "fov_deg": "Angle across the middle of an image, from edge to edge.",
}
_POSES = {
    "panorama_axes": "Right-handed: x to the middle column of the panorama, y to the left of it, "
    "z to the top row.",
    "world_from_panorama": "Rotation matrix by rows, determinant +1: the point seen at distance r "
    "in direction d of the panorama is location + r · world_from_panorama · d.",
    "location": "Centre of the panorama, in the world and the units of COLMAP's model.",
}
_NUMBERS = re.compile(r"\[[-+.,\d\se]+\]")
"""Rows of matrices, which are easier to read on one line."""

_EXPECTED = "the cameras of tangent images, as tangent-render writes them beside the images"
_KINDS: dict[str, Any] = {
    "format": Literal["tangent images"],
    "source": dict,
    "base_level": int,
    "level": int,
    "dim": int,
    "icosahedron_rotation": list[list[float]] | None,
    "images": list,
}


@dataclass(frozen=True)
class CameraFile:
    """Content of a ``cameras.json``.

    Attributes:
        source: Name of the panorama.
        shape: ``(H, W)`` of the panorama.
        grid: The geometry of all images.
        faces: Indices of its images.
        files: The files' names, one for each face.
    """

    source: str
    shape: tuple[int, int]
    grid: TangentGrid
    faces: tuple[int, ...]
    files: tuple[str, ...]


def write_cameras(path: Path, cameras: CameraFile) -> None:
    """Write a ``cameras.json``.

    Args:
        path: The file.
        cameras: Its content; its ``conventions`` define the fields.
    """
    grid = cameras.grid
    rotation = None if grid.rotation is None else _in_world(grid.rotation).tolist()
    content = {
        "format": _FORMAT,
        "conventions": _CONVENTIONS,
        "source": {
            "file": cameras.source,
            "height": cameras.shape[0],
            "width": cameras.shape[1],
        },
        "base_level": grid.base_level,
        "level": grid.level,
        "dim": grid.dim,
        "icosahedron_rotation": rotation,
        "camera": {
            "width": grid.dim,
            "height": grid.dim,
            "matrix": grid.camera_matrix.tolist(),
            "fov_deg": math.degrees(2 * math.atan(grid.dim * grid.pitch / 2)),
        },
        "images": [
            {
                "file": file,
                "face": face,
                "world_from_camera": _world_from_camera(grid, face).tolist(),
            }
            for face, file in zip(cameras.faces, cameras.files, strict=True)
        ],
    }
    _write_json(path, content)


def _world_from_camera(grid: TangentGrid, face: int) -> NDArray[np.float64]:
    """``(3, 3)`` proper rotation from camera axes to the right-handed world of the files."""
    return np.asarray(FLIP_Y @ grid.world_from_camera[face])


def _in_world(rotation: NDArray[np.float64]) -> NDArray[np.float64]:
    """A rotation of the library's frame in the right-handed world, or back."""
    return np.asarray(FLIP_Y @ rotation @ FLIP_Y)


def read_cameras(path: Path) -> CameraFile:
    """Read a ``cameras.json``.

    Args:
        path: The file.

    Raises:
        DataError: It is missing, or cannot be what `write_cameras` wrote.
    """
    try:
        content = parse_json(path.read_bytes())
    except (OSError, ValueError) as error:
        raise DataError(path, found=error, expected=_EXPECTED) from error
    fields = check_fields(path, content, _KINDS, _EXPECTED)
    kinds: dict[str, Any] = {"height": int, "width": int}
    source = check_fields(path, fields["source"], kinds, _EXPECTED, "source")
    kinds = {"file": Text, "face": int}
    images = [check_fields(path, i, kinds, _EXPECTED, "images") for i in fields["images"]]
    shape = source["height"], source["width"]
    faces, files = (tuple(image[name] for image in images) for name in ("face", "file"))
    if not 1 <= min(shape) <= max(shape) <= _MOST_PIXELS:
        raise DataError(path, found=f"a source of {shape} pixels", expected=_EXPECTED)
    if len(set(faces)) < len(faces) or len({Path(file).stem for file in files}) < len(files):
        raise DataError(path, found="an image twice", expected=_EXPECTED)
    try:
        rotation = fields["icosahedron_rotation"]
        with np.errstate(over="ignore", invalid="ignore"):  # huge numbers are no rotation
            turn = rotation and _in_world(np.array(rotation, np.float64).reshape(3, 3))
            grid = TangentGrid(fields["base_level"], fields["level"], fields["dim"], turn)
        grid.face_indices(faces)
    except (ValueError, OverflowError) as error:
        raise DataError(path, found=error, expected=_EXPECTED) from error
    return CameraFile(str(fields["source"].get("file")), shape, grid, faces, files)


@dataclass(frozen=True)
class RigFile:
    """Content of a ``rig_config.json``: the images of a panorama as a rig of cameras, for COLMAP.

    Attributes:
        world_from_camera: ``(3, 3)`` rotation of each camera by the prefix of its images' names,
            ``face_000/``, in the world of `write_cameras`. The first is COLMAP's reference.
        panoramas: Files of panoramas by what follows the prefix: ``room.png``.
    """

    world_from_camera: Mapping[str, NDArray[np.float64]]
    panoramas: Mapping[str, str]

    @property
    def images(self) -> list[str]:
        """Names of all images, as COLMAP has them."""
        return [prefix + name for prefix in self.world_from_camera for name in self.panoramas]


def write_rig(
    path: Path, grid: TangentGrid, faces: Mapping[str, int], panoramas: Mapping[str, str]
) -> None:
    """Write a ``rig_config.json`` for COLMAP 3.12 or later.

    All cameras are PINHOLE, their centre is counted from pixel corners, and none is moved. COLMAP
    passes over the fields of `RigFile` that are not its own.

    Args:
        path: The file.
        grid: The images.
        faces: Index of the image of each camera, by prefix.
        panoramas: See `RigFile`.
    """
    from scipy.spatial.transform import Rotation  # slow to import

    focal, center = 1 / grid.pitch, grid.dim / 2
    reference = _world_from_camera(grid, next(iter(faces.values())))
    cameras: list[dict[str, Any]] = []
    for prefix, face in faces.items():
        axes = _world_from_camera(grid, face)
        turn = Rotation.from_matrix(axes.T @ reference)
        of_rig = {
            "cam_from_rig_rotation": turn.as_quat(canonical=True, scalar_first=True).tolist(),
            "cam_from_rig_translation": (0, 0, 0),
        }
        cameras.append(
            {
                "image_prefix": prefix,
                **(of_rig if cameras else {"ref_sensor": True}),
                "camera_model_name": "PINHOLE",
                "camera_params": (focal, focal, center, center),
                "world_from_camera": axes.tolist(),
            }
        )
    _write_json(path, [{"cameras": cameras, "panoramas": panoramas}])


def read_rig(path: Path) -> RigFile:
    """Read what `write_rig` wrote.

    Raises:
        DataError: It is missing, or is another.
    """
    try:
        (rig,) = parse_json(path.read_bytes())
        with np.errstate(over="ignore", invalid="ignore"):  # huge numbers are no rotation
            axes = {
                str(camera["image_prefix"]): checked_rotation(camera["world_from_camera"])
                for camera in rig["cameras"]
            }
        return RigFile(axes, {name: str(file) for name, file in rig["panoramas"].items()})
    except (OSError, ValueError, TypeError, KeyError, AttributeError, OverflowError) as error:
        raise DataError(
            path,
            found=f"{type(error).__name__}: {error}",
            expected="the rig that tangent-render wrote with colmap=true",
        ) from error


def write_poses(path: Path, poses: Mapping[str, PanoramaPose]) -> None:
    """Write poses of panoramas in a right-handed world as JSON; ``conventions`` defines its fields.

    Args:
        path: The file.
        poses: By file of the panorama.
    """
    panoramas = [
        {
            "file": file,
            "location": pose.location_m.tolist(),
            "world_from_panorama": (pose.world_from_panorama @ FLIP_Y).tolist(),
        }
        for file, pose in poses.items()
    ]
    content = {"format": "panorama poses", "conventions": _POSES, "panoramas": panoramas}
    _write_json(path, content)


def _write_json(path: Path, content: Any) -> None:
    text = json.dumps(content, indent=1, ensure_ascii=False)
    write_text(path, _NUMBERS.sub(lambda match: " ".join(match[0].split()), text) + "\n")
