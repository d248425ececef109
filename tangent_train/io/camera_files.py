"""Files with the cameras of pinhole images: ``cameras.json``, and COLMAP's ``rig_config.json``.

Their world frame is right-handed: x forward (to the middle column of the panorama), y left, z up.
`to_right_handed` converts between it and the frame of `tangent_train.geometry`.
"""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path, PurePath
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, BaseModel, Field

from tangent_train.errors import DataError
from tangent_train.files import read_json, write_text
from tangent_train.geometry import (
    PanoramaPose,
    PinholeGrid,
    TangentGrid,
    checked_rotation,
    to_right_handed,
)
from tangent_train.geometry.coverage import overlaps

CAMERAS_FILE = "cameras.json"
"""Name of the file in a folder of tangent images."""

RIG_FILE = "rig_config.json"
"""Name of the file in a COLMAP project."""

View = tuple[PinholeGrid, int]
"""An image of a grid, by its index."""

_MOST_PIXELS = 2**20  # limit for rows and columns: a panorama of the size in the file is allocated
_EXPECTED_POSES = "poses.json, a .csv file with file, x, y, z, or a folder of tran.txt and rot.txt"
LOCATION_FILE = "tran.txt"
"""End of the names of files with the location of a panorama."""

_FROM_OPENGL = np.array([[0.0, 0, -1], [-1, 0, 0], [0, 1, 0]])
_NUMBERS = re.compile(r"\[[-+.,\d\se]+\]")
"""Matches lists of numbers, which are written on one line."""

_EXPECTED = "the cameras of tangent images, as tangent-render writes them beside the images"
_Side = Annotated[int, Field(ge=2, le=_MOST_PIXELS)]
_Row = tuple[float, float, float]
_Matrix = tuple[tuple[Annotated[float, Field(gt=0)], float, float], _Row, _Row]


_Rotation = Annotated[list[list[float]], AfterValidator(checked_rotation)]


class _Source(BaseModel):
    file: str
    height: _Side
    width: _Side


class _Camera(BaseModel):
    width: _Side
    height: _Side
    matrix: _Matrix


class _Image(BaseModel):
    file: str
    face: int


class _CamerasJson(BaseModel):
    """Fields of a ``cameras.json`` that are read: of tangent images, or of other views."""

    format: Literal["tangent images"]
    source: _Source
    camera: _Camera | None
    images: list[_Image]
    base_level: int | None = None
    level: int = 0
    dim: int | None = None
    icosahedron_rotation: _Rotation | None = None
    views: list[_Rotation] = []
    overlapping: bool = False

    @property
    def faces(self) -> tuple[int, ...]:
        return tuple(image.face for image in self.images)

    def grid(self) -> PinholeGrid:
        """Return the grid that the fields describe."""
        if self.base_level is not None:
            rotation: Any = self.icosahedron_rotation
            in_world = None if rotation is None else _in_world(rotation)
            return TangentGrid(self.base_level, self.level, self.dim, in_world)
        if self.camera is None:
            raise ValueError("views of several fields of view, which cannot be rendered back")
        axes = np.stack([to_right_handed(np.transpose(view)).T for view in self.views])
        size = self.camera.height, self.camera.width
        pitch, row_pitch = (1 / self.camera.matrix[axis][axis] for axis in (0, 1))
        kinds: Any = {"row_pitch": row_pitch, "is_overlapping": self.overlapping}
        return PinholeGrid(axes, size, pitch, **kinds)


@dataclass(frozen=True)
class CameraFile:
    """Content of a ``cameras.json``.

    Attributes:
        source: Name of the panorama.
        shape: ``(H, W)`` of the panorama.
        grid: Geometry of all images.
        faces: Indices of the images that have a file.
        files: File name of each face.
        others: Images of other fields of view, whose indices follow those of the grid.
    """

    source: str
    shape: tuple[int, int]
    grid: PinholeGrid
    faces: tuple[int, ...]
    files: tuple[str, ...]
    others: tuple[PinholeGrid, ...] = ()

    @property
    def items(self) -> list[tuple[str, int]]:
        """File name and index of the images that have a file."""
        return list(zip(self.files, self.faces, strict=True))

    @property
    def views(self) -> list[View]:
        """All images, in the order of their indices."""
        grids = (self.grid, *self.others)
        return [(grid, int(face)) for grid in grids for face in grid.face_indices()]


def write_cameras(path: Path, cameras: CameraFile) -> None:
    """Write a ``cameras.json``.

    Args:
        path: File to write.
        cameras: Content of the file, see docs/reference/file_formats.md.
    """
    grid, views = cameras.grid, cameras.views
    described: dict[str, Any] = {
        "views": [_world_from_camera(*view) for view in views],
        "overlapping": grid.is_overlapping if grid.is_complete else overlaps(grid),
    }
    if isinstance(grid, TangentGrid) and not cameras.others:
        rotation = None if grid.rotation is None else _in_world(grid.rotation).tolist()
        described = {"base_level": grid.base_level, "level": grid.level, "dim": grid.dim}
        described |= {"icosahedron_rotation": rotation}
    height, width = cameras.shape
    content = {
        "format": "tangent images",
        "source": {"file": cameras.source, "height": height, "width": width},
        **described,
        "camera": None if cameras.others else _camera(grid),
        "images": [
            {
                "file": file,
                "face": face,
                **({"camera": _camera(views[face][0])} if cameras.others else {}),
                "world_from_camera": _world_from_camera(*views[face]),
            }
            for face, file in zip(cameras.faces, cameras.files, strict=True)
        ],
    }
    _write_json(path, content)


def _camera(grid: PinholeGrid) -> dict[str, Any]:
    matrix, (rows, columns) = grid.camera_matrix.tolist(), grid.size
    return {"width": columns, "height": rows, "matrix": matrix, "fov_deg": grid.width_deg}


def _world_from_camera(grid: PinholeGrid, face: int) -> list[list[float]]:
    """Return the rotation ``(3, 3)`` from camera axes to the right-handed world of the files."""
    rotation: list[list[float]] = to_right_handed(grid.world_from_camera[face].T).T.tolist()
    return rotation


def _in_world(rotation: NDArray[np.float64]) -> NDArray[np.float64]:
    """Convert a rotation between the library's frame and the right-handed world, either way."""
    return to_right_handed(to_right_handed(rotation).T).T


def read_cameras(path: Path) -> CameraFile:
    """Read a ``cameras.json``.

    Args:
        path: File to read.

    Raises:
        DataError: The file is missing, or its content is not valid.
    """
    content: _CamerasJson = read_json(path, _EXPECTED, kind=_CamerasJson)
    try:
        grid = content.grid()
        grid.face_indices(content.faces)
    except (ValueError, IndexError, OverflowError) as error:
        raise DataError(path, found=error, expected=_EXPECTED) from error
    shape = content.source.height, content.source.width
    files = tuple(image.file for image in content.images)
    return CameraFile(content.source.file, shape, grid, content.faces, files)


class _RigCamera(BaseModel):
    image_prefix: str
    world_from_camera: _Rotation


class _RigJson(BaseModel):
    cameras: list[_RigCamera]
    panoramas: dict[str, str]


@dataclass(frozen=True)
class RigFile:
    """Content of a ``rig_config.json``: the images of a panorama as a rig of cameras, for COLMAP.

    Attributes:
        world_from_camera: ``(3, 3)`` rotation of each camera in the world of `write_cameras`, by
            the prefix of its images' names (``face_000/``). The first is COLMAP's reference.
        panoramas: File of each panorama, by the rest of its images' names (``room.png``).
    """

    world_from_camera: Mapping[str, NDArray[np.float64]]
    panoramas: Mapping[str, str]

    @property
    def images(self) -> list[str]:
        """Names of all images, as in COLMAP."""
        return [prefix + name for prefix in self.world_from_camera for name in self.panoramas]


def write_rig(path: Path, views: Mapping[str, View], panoramas: Mapping[str, str]) -> None:
    """Write a ``rig_config.json`` for COLMAP 3.12 or later.

    All cameras have COLMAP's model PINHOLE and the same center; principal points are counted from
    pixel corners. COLMAP ignores the fields ``world_from_camera`` and ``panoramas``.

    Args:
        path: File to write.
        views: Image of each camera, by prefix.
        panoramas: See `RigFile`.
    """
    from scipy.spatial.transform import Rotation  # slow to import

    first, view = next(iter(views.items()))
    of_first = _world_from_camera(*view)
    cameras: list[dict[str, Any]] = []
    for prefix, (grid, face) in views.items():
        (rows, columns), axes = grid.size, _world_from_camera(grid, face)
        from_rig = np.transpose(axes) @ of_first
        quaternion = Rotation.from_matrix(from_rig).as_quat(canonical=True, scalar_first=True)
        of_rig = {
            "cam_from_rig_rotation": quaternion.tolist(),
            "cam_from_rig_translation": (0, 0, 0),
        }
        cameras.append(
            {
                "image_prefix": prefix,
                **({"ref_sensor": True} if prefix == first else of_rig),
                "camera_model_name": "PINHOLE",
                "camera_params": (1 / grid.pitch, 1 / grid.row_pitch, columns / 2, rows / 2),
                "world_from_camera": axes,
            }
        )
    _write_json(path, [{"cameras": cameras, "panoramas": panoramas}])


def read_rig(path: Path) -> RigFile:
    """Read a ``rig_config.json`` that `write_rig` wrote.

    Raises:
        DataError: The file is missing, or another program wrote it.
    """
    expected = "the rig that tangent-render wrote with colmap=true"
    (rig,) = read_json(path, expected, kind=tuple[_RigJson])
    axes = {camera.image_prefix: camera.world_from_camera for camera in rig.cameras}
    return RigFile(axes, rig.panoramas)


def write_poses(path: Path, poses: Mapping[str, PanoramaPose]) -> None:
    """Write poses of panoramas in a right-handed world as JSON.

    Args:
        path: File to write, see docs/reference/file_formats.md.
        poses: Pose of each panorama, by its file.
    """
    panoramas = [
        {
            "file": file,
            "location": pose.location_m.tolist(),
            "world_from_panorama": to_right_handed(pose.world_from_panorama).tolist(),
        }
        for file, pose in poses.items()
    ]
    content = {"format": "panorama poses", "panoramas": panoramas}
    _write_json(path, content)


class _Pose(BaseModel):
    file: str
    location: tuple[float, float, float]
    world_from_panorama: _Rotation


class _PosesJson(BaseModel):
    panoramas: list[_Pose]


def read_poses(path: Path) -> dict[str, PanoramaPose]:
    """Read poses of panoramas, by file.

    Args:
        path: JSON file of `write_poses`; CSV table of `file`, the location `x`, `y`, `z` and
            optionally the rotation `qw`, `qx`, `qy`, `qz`, in the axes of `write_poses`; or folder
            whose ``…tran.txt`` and ``…rot.txt`` are location and rotation of ``…rgb.png``, in
            OpenGL's axes (x right, y up, z back), as of PanSplat.

    Raises:
        DataError: A file is missing, or has other content.
    """
    if path.is_file() and path.suffix != ".csv":
        content: _PosesJson = read_json(path, _EXPECTED_POSES, kind=_PosesJson)
        poses = [(pose.file, pose.world_from_panorama, pose.location) for pose in content.panoramas]
    else:
        try:
            poses = [*(_folder_poses if path.is_dir() else _table_poses)(path)]
        except (OSError, ValueError, LookupError, TypeError) as error:
            raise DataError(path, found=error, expected=_EXPECTED_POSES) from error
    return {file: PanoramaPose(to_right_handed(axes), location) for file, axes, location in poses}


def _table_poses(path: Path) -> Iterator[tuple[str, Any, Any]]:
    from scipy.spatial.transform import Rotation  # slow to import

    for row in csv.DictReader(path.read_text("utf-8-sig").splitlines()):
        quaternion = [float(row.get(f"q{axis}", axis == "w")) for axis in "wxyz"]
        axes = Rotation.from_quat(quaternion, scalar_first=True).as_matrix()
        yield row["file"], axes, [float(row[axis]) for axis in "xyz"]


def _folder_poses(path: Path) -> Iterator[tuple[str, Any, Any]]:
    for file in sorted(path.rglob("*" + LOCATION_FILE)):
        prefix = str(file).removesuffix(LOCATION_FILE)
        axes = checked_rotation(np.loadtxt(f"{prefix}rot.txt"))
        name = PurePath(prefix + "rgb.png").relative_to(path).as_posix()
        yield name, _FROM_OPENGL @ axes @ _FROM_OPENGL.T, _FROM_OPENGL @ np.loadtxt(file)


def _write_json(path: Path, content: Any) -> None:
    text = json.dumps(content, indent=1, ensure_ascii=False)
    write_text(path, _NUMBERS.sub(lambda match: " ".join(match[0].split()), text) + "\n")
