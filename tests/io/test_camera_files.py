"""Files of cameras contain the positions of pixels; here they are read by other code."""

from __future__ import annotations

import json
from pathlib import Path, PurePath
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from tangent_train.errors import DataError
from tangent_train.geometry import PinholeGrid, RingGrid, TangentGrid, random_rotation
from tangent_train.io.camera_files import (
    CameraFile,
    read_cameras,
    read_poses,
    read_rig,
    write_cameras,
)
from tangent_train.rendering import equirect_to_tangent

ROTATION = random_rotation(np.random.default_rng(3))
RINGS = [{"pitch": pitch, "views": 8} for pitch in (0, 45, -45)]
GRIDS: list[PinholeGrid] = [
    TangentGrid(0, 4),
    TangentGrid(1, 6, dim=25, rotation=ROTATION),
    RingGrid(RINGS, (80, 100), (30, 21), ROTATION),
    RingGrid(RINGS, (80, 100), (30, 40), ROTATION, square_pixels=False),
]
CAMERA = {"width": 21, "height": 30, "matrix": np.eye(3).tolist()}
FACES = (0, 7, 11, 19)


def _cameras(grid: PinholeGrid, faces: tuple[int, ...] = FACES) -> CameraFile:
    files = tuple(f"face_{face:03}.png" for face in faces)
    return CameraFile("room (1).jpg", (100, 200), grid, faces, files)


def _world_panorama(height: int) -> NDArray[np.float64]:
    """``(H, 2H, 3)``: each pixel contains its direction in the world of the files (y is left)."""
    left = np.pi - (np.arange(2 * height) + 0.5) / height * np.pi
    up = np.pi / 2 - (np.arange(height) + 0.5) / height * np.pi
    left, up = np.meshgrid(left, up)
    return np.stack([np.cos(up) * np.cos(left), np.cos(up) * np.sin(left), np.sin(up)], axis=-1)


@pytest.mark.parametrize("grid", GRIDS)
def test_pixels_are_at_the_positions_in_the_file(grid: PinholeGrid, tmp_path: Path) -> None:
    path, cameras = tmp_path / "new folder" / "cameras.json", _cameras(grid)
    write_cameras(path, cameras)
    again = read_cameras(path)
    assert (again == cameras) is isinstance(grid, TangentGrid)
    assert (again.faces, again.files) == (cameras.faces, cameras.files)
    assert again.grid.is_overlapping is grid.is_overlapping
    np.testing.assert_allclose(again.grid.directions(), grid.directions(), atol=1e-12)
    content = json.loads(path.read_text())
    seen = equirect_to_tangent(_world_panorama(500), grid, FACES)
    matrix = np.array(content["camera"]["matrix"])
    rows, columns = grid.size
    assert (content["camera"]["height"], content["camera"]["width"]) == grid.size
    edge_deg = np.degrees(2 * np.arctan(columns / 2 / matrix[0, 0]))
    assert content["camera"]["fov_deg"] == pytest.approx(edge_deg)
    for image, shown in zip(content["images"], seen, strict=True):
        rotation = np.array(image["world_from_camera"])
        assert np.linalg.det(rotation) == pytest.approx(1)
        for row, column in ((0, 0), (3, 11), (rows - 1, 2)):
            ray = rotation @ np.linalg.inv(matrix) @ (column, row, 1)
            seen_ray = shown[row, column] / np.linalg.norm(shown[row, column])  # means are shorter
            np.testing.assert_allclose(seen_ray, ray / np.linalg.norm(ray), atol=5e-4)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"dim": 2}, "at least"),
        ({"icosahedron_rotation": [[1, 0, 0], [0, 1, 0], [0, 0, -1]]}, "rotation"),
        ({"views": [[[1, 0, 0], [0, 1, 0], [0, 0, -1]]]}, "rotation"),
        ({"camera": CAMERA | {"matrix": (-9 * np.eye(3)).tolist()}}, "camera.matrix"),
        ({"images": [{"file": "a.png", "face": 20}]}, "20"),
    ],
)
def test_inconsistent_files_are_refused(
    changes: dict[str, Any], message: str, tmp_path: Path
) -> None:
    path = tmp_path / "cameras.json"
    write_cameras(path, _cameras(GRIDS[2 if {"views", "camera"} & changes.keys() else 0]))
    content = json.loads(path.read_text()) | changes
    path.write_text(json.dumps(content))
    with pytest.raises(DataError, match=rf"cameras\.json: .*{message}"):
        read_cameras(path)


@pytest.mark.parametrize("read", [read_cameras, read_rig])
@pytest.mark.parametrize(
    "content",
    [
        None,
        b"\xff\xfe\x00",
        b'[{"cameras": [{"image_prefix": "a/", "ref_sensor": true}], "panoramas": {}}]',
        b'[{"cameras": [{"image_prefix": "a/", "world_from_camera": [1, 2]}], "panoramas": {}}]',
    ],
)
def test_other_files_are_refused(read: Any, content: bytes | None, tmp_path: Path) -> None:
    if content is not None:
        (tmp_path / "other.json").write_bytes(content)
    with pytest.raises(DataError, match=r"other\.json.*tangent-render"):
        read(tmp_path / "other.json")


def test_a_table_of_poses(tmp_path: Path) -> None:
    """`b` is rotated by 90° to the left; y of directions is to the right, of the table left."""
    table = "file,x,y,z,qw,qx,qy,qz\na.png,1,2,3,1,0,0,0\nb.png,0,0,1,0.5,0,0,0.5\n"
    (tmp_path / "poses.csv").write_text("\ufeff" + table)
    poses = read_poses(tmp_path / "poses.csv")
    ahead_right_up = np.eye(3)
    found = {file: pose.points_m(ahead_right_up, 2.0) for file, pose in poses.items()}
    np.testing.assert_allclose(found["a.png"], [(3, 2, 3), (1, 0, 3), (1, 2, 5)], atol=1e-9)
    np.testing.assert_allclose(found["b.png"], [(0, 2, 1), (2, 0, 1), (0, 0, 3)], atol=1e-9)
    (tmp_path / "short.csv").write_text("file,x,y,z\na.png,1,2,3\n")
    short = read_poses(tmp_path / "short.csv")["a.png"]
    np.testing.assert_allclose(short.points_m(ahead_right_up, 2.0), found["a.png"])


def test_a_folder_of_poses_has_the_axes_of_opengl(tmp_path: Path) -> None:
    rotation, location = random_rotation(np.random.default_rng(1)), np.array([0.3, -0.2, 0.7])
    for prefix in ("00_", "hall/"):
        (tmp_path / "hall").mkdir(exist_ok=True)
        np.savetxt(tmp_path / f"{prefix}rot.txt", rotation)
        np.savetxt(tmp_path / f"{prefix}tran.txt", location)
    poses = read_poses(tmp_path)
    assert poses.keys() == {"00_rgb.png", "hall/rgb.png"}
    ahead_right_up = np.array([(0, 0, -1), (1, 0, 0), (0, 1, 0)])  # x right, y up, z back
    x, y, z = (2 * ahead_right_up @ rotation.T + location).T
    expected = np.stack([-z, -x, y], axis=1)
    for pose in poses.values():
        np.testing.assert_allclose(pose.points_m(np.eye(3), 2.0), expected, atol=1e-9)


@pytest.mark.parametrize(
    ("file", "content"),
    [
        ("poses.csv", "name,x,y,z\na,1,2,3\n"),
        ("poses.csv", "file,x,y,z\na,1,2\n"),
        ("poses.csv", "file,x,y,z\na,1,2,west\n"),
        ("poses.csv", "file,x,y,z,qw,qx,qy,qz\na,1,2,3,0,0,0,0\n"),
        ("poses.json", "file,x,y,z\na,1,2,3\n"),
        ("poses/tran.txt", "1 2 3"),
    ],
)
def test_other_poses_are_refused(file: str, content: str, tmp_path: Path) -> None:
    (tmp_path / file).parent.mkdir(exist_ok=True)
    (tmp_path / file).write_text(content)
    with pytest.raises(DataError, match=r"poses.*expected .*\.csv"):
        read_poses(tmp_path / PurePath(file).parts[0])
