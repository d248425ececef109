"""Files of cameras contain the positions of pixels; here they are read by other code."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from tangent_train.errors import DataError
from tangent_train.geometry import PinholeGrid, RingGrid, TangentGrid, random_rotation
from tangent_train.io.camera_files import CameraFile, read_cameras, read_rig, write_cameras
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
