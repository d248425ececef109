"""Readers of text: classes, poses, cameras, meshes; valid files to break, what has to come out."""

from __future__ import annotations

import json
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from datamodules.core.label_table import CLASSES, LabelTable
from datamodules.folder.classes import read_classes
from datamodules.modelnet40.off_files import read_off
from datamodules.stanford2d3ds.perspective import read_camera_matrix
from datamodules.stanford2d3ds.poses import read_panorama_pose
from tangent_train.geometry import TangentGrid, rotation_about
from tangent_train.rendering.camera_files import CameraFile, read_cameras, write_cameras
from tests.slow.fuzz.pixels import DEPTH, RGB, SHAPE

__all__ = [
    "camera_seeds",
    "class_seeds",
    "off_seeds",
    "pose_seeds",
    "read_camera_list",
    "read_class_list",
    "read_mesh",
    "read_pose",
    "read_table",
    "table_seeds",
]


def table_seeds() -> list[bytes]:
    names = ["<UNK>_0_<UNK>_0_0", *(f"{name}_{i}_office_{i}_1" for i, name in enumerate(CLASSES))]
    return [json.dumps(names).encode(), json.dumps(names[:3], indent=1).encode()]


def read_table(path: Path) -> None:
    ids = LabelTable.from_json(path).class_ids
    assert ids.dtype == np.uint8
    assert 0 <= ids.min() <= ids.max() <= len(CLASSES)


def pose_seeds() -> list[bytes]:
    turn = np.array([[0.0, 1, 0, 0.5], [0, 0, -1, 1.5], [-1, 0, 0, -2]])
    pose: dict[str, Any] = {
        "camera_rt_matrix": turn.tolist(),
        "camera_original_rotation": [1.5708, 0.0, 0.3],
        "camera_location": [-0.5, 2.25, 1.5],
        "room": "office_1",
    }
    square = pose | {"camera_rt_matrix": [*turn.tolist(), [0, 0, 0, 1]]}
    photo = {"camera_k_matrix": [[100.0, 0, 32], [0, 100.0, 32], [0, 0, 1]]}
    return [
        json.dumps(pose).encode(),
        json.dumps(square, indent=1).encode(),
        json.dumps(photo).encode(),
    ]


def read_pose(path: Path) -> None:
    if b"camera_k_matrix" in path.read_bytes():
        assert read_camera_matrix(path).shape == (3, 3)
        return
    pose = read_panorama_pose(path)
    turn = pose.world_from_panorama
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-4)
    assert np.isfinite(pose.location_m).all()


def class_seeds() -> list[bytes]:
    forms: list[Any] = [[None, "wall", "floor"], {"wall": 1, "floor": [2, 3], "window": 255}]
    forms.append({"wall": "#ff0000", "floor": ["#00ff00", "#00ee00"]})
    return [json.dumps(form).encode() for form in forms]


def read_class_list(path: Path) -> None:
    classes = read_classes(path)
    assert 1 <= len(classes.names) <= 255
    assert len(classes.codes) == len(classes.labels) > 0
    assert classes.decode(RGB if classes.in_colors else DEPTH).shape == SHAPE


def off_seeds() -> list[bytes]:
    points = b"0 0 0\n1 0 0\n1 1 0\n0 1 0.5\n"
    return [
        b"OFF\n4 2 0\n" + points + b"3 0 1 2\n3 0 2 3\n",
        b"OFF4 2 0\n" + points + b"3 0 1 2 255 0 0\n4 3 0 1 2\n",
        b"COFF # a mesh\n4 3 0\n" + points.replace(b"\n", b" 1 2 3 4\r\n") + b"2 0 1\n3 0 1 2\n0\n",
        b"OFF\n100 98 0\n"
        + b"".join(b"%d %d %d\n" % (i, i * i, i % 7) for i in range(100))
        + b"".join(b"3 %d %d %d\n" % (i, i + 1, i + 2) for i in range(98)),
    ]


def read_mesh(path: Path) -> None:
    vertices, triangles = read_off(path)
    assert np.isfinite(vertices).all()
    assert vertices.shape[1] == triangles.shape[1] == 3
    assert 0 <= triangles.min() <= triangles.max() < len(vertices)


def camera_seeds() -> list[bytes]:
    turned = TangentGrid(1, 5, 20, rotation_about(np.array([0, 0, 1.0]), 0.3))
    seeds = []
    with TemporaryDirectory() as folder:
        path = Path(folder) / "cameras.json"
        for grid, faces in ((TangentGrid(0, 4), range(20)), (turned, (3, 7))):
            files = tuple(f"{face:05d}.png" for face in faces)
            write_cameras(path, CameraFile("room.jpg", (64, 128), grid, tuple(faces), files))
            seeds.append(path.read_bytes())
    return seeds


def read_camera_list(path: Path) -> None:
    cameras = read_cameras(path)
    assert len(cameras.faces) == len(cameras.files)
    assert cameras.grid.directions(cameras.faces[:1]).shape[1:] == (cameras.grid.dim,) * 2 + (3,)
