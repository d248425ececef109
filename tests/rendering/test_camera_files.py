"""The cameras that are written say where the pixels of the images are: read by hand here."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from tangent_train.errors import DataError
from tangent_train.geometry import TangentGrid, random_rotation
from tangent_train.rendering import (
    CameraFile,
    equirect_to_tangent,
    read_cameras,
    write_cameras,
    write_colmap,
)

TURN = random_rotation(np.random.default_rng(3))
GRIDS = [TangentGrid(0, 4), TangentGrid(1, 6, dim=25, rotation=TURN)]
FACES = (0, 7, 11, 19)


def _cameras(grid: TangentGrid, faces: tuple[int, ...] = FACES) -> CameraFile:
    files = tuple(f"face_{face:03}.png" for face in faces)
    return CameraFile("room (1).jpg", (100, 200), grid, faces, files)


def _world_panorama(height: int) -> NDArray[np.float64]:
    """``(H, 2H, 3)``: every pixel holds its place in the world of the files: y is to the left."""
    left = np.pi - (np.arange(2 * height) + 0.5) / height * np.pi
    up = np.pi / 2 - (np.arange(height) + 0.5) / height * np.pi
    left, up = np.meshgrid(left, up)
    return np.stack([np.cos(up) * np.cos(left), np.cos(up) * np.sin(left), np.sin(up)], axis=-1)


@pytest.mark.parametrize("grid", GRIDS)
def test_pixels_are_where_the_file_says(grid: TangentGrid, tmp_path: Path) -> None:
    write_cameras(tmp_path / "cameras.json", _cameras(grid))
    content = json.loads((tmp_path / "cameras.json").read_text())
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


@pytest.mark.parametrize("grid", GRIDS)
def test_what_is_written_is_read(grid: TangentGrid, tmp_path: Path) -> None:
    cameras = _cameras(grid)
    write_cameras(tmp_path / "new folder" / "cameras.json", cameras)
    again = read_cameras(tmp_path / "new folder" / "cameras.json")
    assert again == cameras
    assert again.grid.dim == grid.dim


def _colmap_model(folder: Path) -> tuple[list[str], dict[str, list[str]]]:
    """The camera, and the images by name, by the rules of COLMAP's documentation."""
    (camera,) = _content(folder / "cameras.txt")
    # Two lines an image; the second, the points, may be empty.
    lines = (folder / "images.txt").read_text().splitlines()
    while lines[0].startswith("#"):
        lines.pop(0)
    assert not any(lines[1::2])
    assert not _content(folder / "points3D.txt")
    images = [line.split(maxsplit=9) for line in lines[::2]]
    assert [int(image[0]) for image in images] == list(range(1, len(images) + 1))
    return camera.split(), {image[9]: image[1:9] for image in images}


def _content(path: Path) -> list[str]:
    return [line for line in path.read_text().splitlines() if line and line[0] != "#"]


@pytest.mark.parametrize("grid", GRIDS)
def test_colmap_sees_points_where_the_images_show_them(grid: TangentGrid, tmp_path: Path) -> None:
    faces = tuple(range(grid.num_images))
    write_colmap(tmp_path, _cameras(grid, faces))
    camera, images = _colmap_model(tmp_path)
    assert camera[:4] == ["1", "PINHOLE", str(grid.dim), str(grid.dim)]
    fx, fy, cx, cy = map(float, camera[4:])
    seen = equirect_to_tangent(_world_panorama(500), grid)
    points = np.random.default_rng(0).normal(size=(200, 3))
    found = 0
    for face, (name, pose) in enumerate(images.items()):
        assert name == f"face_{face:03}.png"
        w, *vector = map(float, pose[:4])
        assert pose[4:] == ["0", "0", "0", "1"]
        # x_camera = R x_world + t, then pixels counted from the corner of the image.
        x, y, z = Rotation.from_quat([*vector, w]).apply(points).T
        ahead = z > 0.1
        column, row = fx * x[ahead] / z[ahead] + cx, fy * y[ahead] / z[ahead] + cy
        inside = (np.minimum(column, row) >= 0) & (np.maximum(column, row) < grid.dim)
        shown = seen[face, np.floor(row[inside]).astype(int), np.floor(column[inside]).astype(int)]
        directions = points[ahead][inside]
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        # The pixel that contains the point: off by half a pixel at most, each way.
        assert np.abs(shown - directions).max(initial=0) < 0.75 * grid.pitch
        exact = _bilinear(seen[face], row[inside] - 0.5, column[inside] - 0.5)
        exact /= np.linalg.norm(exact, axis=1, keepdims=True)
        within = np.abs(np.stack([row, column])[:, inside] - grid.dim / 2).max(axis=0)
        middle = within < grid.dim / 2 - 1
        np.testing.assert_allclose(exact[middle], directions[middle], atol=4e-3)
        found += int(middle.sum())
    assert found > 200


def _bilinear(
    image: NDArray[np.float64], row: NDArray[np.float64], column: NDArray[np.float64]
) -> NDArray[np.float64]:
    top, left = (np.clip(np.floor(x), 0, len(image) - 2).astype(int) for x in (row, column))
    down, right = (row - top)[:, None], (column - left)[:, None]
    above = (1 - right) * image[top, left] + right * image[top, left + 1]
    below = (1 - right) * image[top + 1, left] + right * image[top + 1, left + 1]
    return np.asarray((1 - down) * above + down * below)


@pytest.mark.parametrize("seed", range(5))
def test_quaternions_of_any_rotation(seed: int, tmp_path: Path) -> None:
    grid = TangentGrid(0, 3, rotation=random_rotation(np.random.default_rng(seed)))
    write_colmap(tmp_path, _cameras(grid, tuple(range(20))))
    write_cameras(tmp_path / "cameras.json", _cameras(grid, tuple(range(20))))
    _, images = _colmap_model(tmp_path)
    for image in json.loads((tmp_path / "cameras.json").read_text())["images"]:
        w, *vector = map(float, images[image["file"]][:4])
        assert w >= 0
        assert np.linalg.norm([w, *vector]) == pytest.approx(1)
        camera_from_world = Rotation.from_quat([*vector, w]).as_matrix()
        np.testing.assert_allclose(camera_from_world.T, image["world_from_camera"], atol=1e-12)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"format": "other"}, "found format='other'"),
        ({"level": True}, "found level=True"),
        ({"dim": 2}, "at least"),
        ({"dim": "gone"}, "no dim"),
        ({"source": {"file": "a.png", "height": 0, "width": 4}}, r"\(0, 4\) pixels"),
        ({"source": {"file": "a.png"}}, "no height"),
        ({"icosahedron_rotation": [[1, 0], [0, 1]]}, "reshape"),
        ({"icosahedron_rotation": [[1, 0, 0], [0, 1, 0], [0, 0, -1]]}, "rotation"),
        ({"images": [{"file": "a.png"}]}, "no face"),
        ({"images": [{"file": "a.png", "face": 20}]}, "0 to 19"),
        ({"images": [{"file": "a.png", "face": 1}, {"file": "a.jpg", "face": 2}]}, "twice"),
        ({"images": [{"file": "a.png", "face": 1}, {"file": "b.png", "face": 1}]}, "twice"),
        ({"images": 3}, "found images=3"),
    ],
)
def test_files_that_cannot_be_right(changes: dict[str, Any], message: str, tmp_path: Path) -> None:
    path = tmp_path / "cameras.json"
    write_cameras(path, _cameras(GRIDS[0]))
    content = json.loads(path.read_text()) | changes
    path.write_text(json.dumps({key: value for key, value in content.items() if value != "gone"}))
    with pytest.raises(DataError, match=rf"cameras\.json: .*{message}"):
        read_cameras(path)


@pytest.mark.parametrize("content", [None, b"", b"[]", b"\xff\xfe\x00"])
def test_files_that_are_no_json(content: bytes | None, tmp_path: Path) -> None:
    if content is not None:
        (tmp_path / "cameras.json").write_bytes(content)
    with pytest.raises(DataError, match=r"cameras\.json.*tangent-render"):
        read_cameras(tmp_path / "cameras.json")
