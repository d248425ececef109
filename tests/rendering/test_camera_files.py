"""Files of cameras contain the positions of pixels; here they are read by other code."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from tangent_train.errors import DataError
from tangent_train.geometry import TangentGrid, random_rotation
from tangent_train.rendering import (
    CameraFile,
    equirect_to_tangent,
    read_cameras,
    read_rig,
    write_cameras,
)

ROTATION = random_rotation(np.random.default_rng(3))
GRIDS = [TangentGrid(0, 4), TangentGrid(1, 6, dim=25, rotation=ROTATION)]
FACES = (0, 7, 11, 19)


def _cameras(grid: TangentGrid, faces: tuple[int, ...] = FACES) -> CameraFile:
    files = tuple(f"face_{face:03}.png" for face in faces)
    return CameraFile("room (1).jpg", (100, 200), grid, faces, files)


def _world_panorama(height: int) -> NDArray[np.float64]:
    """``(H, 2H, 3)``: each pixel contains its direction in the world of the files (y is left)."""
    left = np.pi - (np.arange(2 * height) + 0.5) / height * np.pi
    up = np.pi / 2 - (np.arange(height) + 0.5) / height * np.pi
    left, up = np.meshgrid(left, up)
    return np.stack([np.cos(up) * np.cos(left), np.cos(up) * np.sin(left), np.sin(up)], axis=-1)


@pytest.mark.parametrize("grid", GRIDS)
def test_pixels_are_at_the_positions_in_the_file(grid: TangentGrid, tmp_path: Path) -> None:
    path, cameras = tmp_path / "new folder" / "cameras.json", _cameras(grid)
    write_cameras(path, cameras)
    assert read_cameras(path) == cameras
    content = json.loads(path.read_text())
    seen = equirect_to_tangent(_world_panorama(500), grid, FACES)
    matrix = np.array(content["camera"]["matrix"])
    assert content["camera"]["width"] == content["camera"]["height"] == grid.dim
    edge_deg = np.degrees(2 * np.arctan(grid.dim / 2 / matrix[0, 0]))
    assert content["camera"]["fov_deg"] == pytest.approx(edge_deg)
    for image, shown in zip(content["images"], seen, strict=True):
        rotation = np.array(image["world_from_camera"])
        assert np.linalg.det(rotation) == pytest.approx(1)
        for row, column in ((0, 0), (3, 11), (grid.dim - 1, 2)):
            ray = rotation @ np.linalg.inv(matrix) @ (column, row, 1)
            np.testing.assert_allclose(shown[row, column], ray / np.linalg.norm(ray), atol=5e-4)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"format": "other"}, "found format='other'"),
        ({"dim": 2}, "at least"),
        ({"dim": "gone"}, "no dim"),
        ({"source": {"file": "a.png", "height": 0, "width": 4}}, r"\(0, 4\) pixels"),
        ({"source": {"file": "a.png", "height": 4, "width": 2**20 + 1}}, "pixels"),
        ({"icosahedron_rotation": [[1, 0, 0], [0, 1, 0], [0, 0, -1]]}, "rotation"),
        ({"images": [{"file": "a.png"}]}, "no face"),
        ({"images": [{"file": "a.png", "face": 20}]}, "0 to 19"),
        ({"images": [{"file": "a.png", "face": 1}, {"file": "a.jpg", "face": 2}]}, "twice"),
        ({"images": [{"file": "a.png", "face": 1}, {"file": "b.png", "face": 1}]}, "twice"),
    ],
)
def test_inconsistent_files_are_refused(
    changes: dict[str, Any], message: str, tmp_path: Path
) -> None:
    path = tmp_path / "cameras.json"
    write_cameras(path, _cameras(GRIDS[0]))
    content = json.loads(path.read_text()) | changes
    path.write_text(json.dumps({key: value for key, value in content.items() if value != "gone"}))
    with pytest.raises(DataError, match=rf"cameras\.json: .*{message}"):
        read_cameras(path)


@pytest.mark.parametrize("read", [read_cameras, read_rig])
@pytest.mark.parametrize(
    "content",
    [
        None,
        b"[]",
        b"\xff\xfe\x00",
        b'[{"cameras": [{"image_prefix": "a/", "ref_sensor": true}], "panoramas": {}}]',
        b'[{"cameras": [], "panoramas": ["a.png"]}]',
        b'[{"cameras": [{"image_prefix": "a/", "world_from_camera": [1, 2]}], "panoramas": {}}]',
    ],
)
def test_other_files_are_refused(read: Any, content: bytes | None, tmp_path: Path) -> None:
    if content is not None:
        (tmp_path / "other.json").write_bytes(content)
    with pytest.raises(DataError, match=r"other\.json.*tangent-render"):
        read(tmp_path / "other.json")
