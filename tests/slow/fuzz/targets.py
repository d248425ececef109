"""Readers of other people's files: valid files to break, and what has to come out."""

from __future__ import annotations

import json
from collections.abc import Callable
from contextlib import suppress
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cv2
import numpy as np
import OpenEXR
from numpy.typing import NDArray
from PIL import Image

from datamodules.core.images import ImageFiles
from datamodules.core.label_map import read_label_map
from datamodules.core.problems import Problems
from datamodules.folder.cameras import read_folder_cameras as read_photo_cameras
from datamodules.modelnet40.meshes import read_off
from datamodules.stanford2d3ds.files import CLASSES
from datamodules.stanford2d3ds.panoramas import (
    read_camera_matrix,
    read_label_table,
    read_panorama_pose,
)
from datamodules.zind.homes import list_home_panoramas
from tangent_train.errors import DataError
from tangent_train.geometry import TangentGrid, rotation_about
from tangent_train.io.camera_files import CameraFile, read_cameras, write_cameras
from tangent_train.io.gpano import read_area, read_up
from tangent_train.io.pixel_files import read_depth_m, read_pixels
from tests.datamodules.data_files import GPANO_TAGS, gpano_xmp, xmp_packet
from tests.datamodules.folder.folder_format import VALUES
from tests.datamodules.zind_format import SQUARE, Camera, write_home

_SHAPE = (8, 16)
_RNG = np.random.default_rng(0)
_RGB: NDArray[np.uint8] = _RNG.integers(0, 256, (*_SHAPE, 3), np.uint8)
_DEPTH: NDArray[np.uint16] = _RNG.integers(0, 5000, _SHAPE, np.uint16)


def _image(
    pixels: NDArray[Any], kind: str = "png", mode: str | None = None, **options: Any
) -> bytes:
    file, image = BytesIO(), Image.fromarray(pixels)
    (image.convert(mode) if mode else image).save(file, kind, **options)
    return file.getvalue()


def _npy(array: NDArray[Any]) -> bytes:
    file = BytesIO()
    np.save(file, array)
    return file.getvalue()


def _json(*contents: Any) -> list[bytes]:
    return [json.dumps(content).encode() for content in contents]


def _table_seeds() -> list[bytes]:
    return _json(["<UNK>_0_<UNK>_0_0", *(f"{n}_{i}_office_{i}_1" for i, n in enumerate(CLASSES))])


def _read_table(path: Path) -> None:
    ids = np.array(list(read_label_table(path).labels.values()))
    assert 0 <= ids.min() <= ids.max() <= len(CLASSES)


def _pose_seeds() -> list[bytes]:
    rotation = [[0.0, 1, 0, 0.5], [0, 0, -1, 1.5], [-1, 0, 0, -2]]
    pose = {"camera_rt_matrix": rotation, "camera_original_rotation": [1.5708, 0.0, 0.3]}
    pose |= {"camera_location": [-0.5, 2.25, 1.5]}
    pose |= {"camera_k_matrix": [[100.0, 0, 32], [0, 100.0, 32], [0, 0, 1]]}
    square = pose | {"camera_rt_matrix": [*rotation, [0, 0, 0, 1]]}
    return _json(pose, square)


def _read_pose(path: Path) -> None:
    assert read_camera_matrix(path).shape == (3, 3)
    pose = read_panorama_pose(path)
    rotation = pose.world_from_panorama
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-4)
    assert np.isfinite(pose.location_m).all()


def _class_seeds() -> list[bytes]:
    return _json([None, "wall", "floor"], VALUES, {"wall": "#ff0000", "floor": ["#00ff00"]})


def _read_class_list(path: Path) -> None:
    classes = read_label_map(path)
    assert 1 <= len(classes.names) <= 255
    assert classes.decode(_RGB if classes.in_colors else _DEPTH * 0).shape == _SHAPE


def _off_seeds() -> list[bytes]:
    points = b"0 0 0\n1 0 0\n1 1 0\n0 1 0.5\n"
    return [
        b"OFF\n4 2 0\n" + points + b"3 0 1 2\n3 0 2 3\n",
        b"OFF4 2 0\n" + points + b"3 0 1 2 255 0 0\n4 3 0 1 2\n",
    ]


def _read_mesh(path: Path) -> None:
    mesh = read_off(path)
    assert np.isfinite(mesh.vertices).all()
    assert 0 <= mesh.faces.min() <= mesh.faces.max() < len(mesh.vertices)


def _camera_seeds() -> list[bytes]:
    rotated = TangentGrid(1, 5, 20, rotation_about(np.array([0, 0, 1.0]), 0.3))
    seeds = []
    with TemporaryDirectory() as folder:
        path = Path(folder) / "cameras.json"
        for grid, faces in (
            (TangentGrid(0, 4), range(20)),
            (rotated, (3, 7)),
            (rotated.subset([3, 7]), (0,)),
        ):
            files = tuple(f"{face:05d}.png" for face in faces)
            write_cameras(path, CameraFile("room.jpg", (64, 128), grid, tuple(faces), files))
            seeds.append(path.read_bytes())
    return seeds


def _read_camera_list(path: Path) -> None:
    cameras = read_cameras(path)
    assert len(cameras.faces) == len(cameras.files)
    assert cameras.grid.directions(cameras.faces[:1]).shape[1:] == (*cameras.grid.size, 3)


def _photo_camera_seeds() -> list[bytes]:
    return _json(
        {"photo": [[14.5, 0, 7.5], [0, 14.5, 3.5], [0, 0, 1]]},
        {".": {"fx": 14.5, "fy": 14.25, "cx": 7.5, "cy": 3.5}},
    )


def _read_photo_cameras(path: Path) -> None:
    photo = path.with_name("photo.png")
    photo.write_bytes(_image(_RGB))
    matrix = read_photo_cameras(path, 60.0).matrix(ImageFiles("photo", photo, photo))
    assert np.isfinite(matrix).all()
    assert 0 < matrix[0, 0] < np.inf


def _home_seeds() -> list[bytes]:
    with TemporaryDirectory() as folder:
        views = [Camera("pano_1"), Camera("pano_2", (0.5, 1), 30)]
        return [write_home(Path(folder) / "000", [(SQUARE, views)], rows=2).read_bytes()]


def _read_home(path: Path) -> None:
    file = path.parent / "000" / "zind_data.json"
    file.parent.mkdir(exist_ok=True)
    path.replace(file)
    problems = Problems()
    panoramas = list_home_panoramas(path.parent, problems)
    problems.refuse(path.parent)
    for panorama in panoramas:
        assert panorama.image().parent == file.parent / "panos"
        pose, unit_m = panorama.pose()
        assert np.isfinite([*pose.location_m, unit_m]).all()
        layout = panorama.layout()
        assert layout.labels(_SHAPE).max() <= 5
        distances = layout.distances(_SHAPE)
        assert ((distances > 0) & (distances < np.inf) | np.isnan(distances)).all()


def _gpano_seeds() -> list[bytes]:
    tags = GPANO_TAGS | {"PosePitchDegrees": "-3.5", "PoseRollDegrees": "12"}
    black = np.zeros((40, 60, 3), np.uint8)
    elements = "".join(f"<GPano:{name}>{value}</GPano:{name}>" for name, value in tags.items())
    forms = gpano_xmp(tags), xmp_packet(f"<rdf:Description>{elements}</rdf:Description>")
    return [_image(black, "webp", xmp=xmp) for xmp in forms]


def _read_gpano(path: Path) -> None:
    up = read_up(path)
    assert up is None or abs(np.linalg.norm(up) - 1) < 1e-9
    area = read_area(path, (40, 60))
    rows, columns = area.places()
    assert (len(rows), len(columns)) == area.image_shape
    assert 0 <= rows.min() <= rows.max() < area.full_shape[0] <= 16384
    assert 0 <= columns.min() <= columns.max() < area.full_shape[1] == 2 * area.full_shape[0]


def _pixel_seeds() -> list[bytes]:
    exif = Image.Exif()
    exif[0x0112] = 6
    seeds = [_npy(_DEPTH), _npy(_RGB), _image(_RGB, mode="P"), _image(_RGB, mode="LA")]
    seeds += [_image(_RGB, kind, exif=exif) for kind in ("png", "webp", "jpeg")]
    seeds += [
        _image(_RGB, "tiff"),
        _image(_RGB, "tiff", "1"),
        _image(_DEPTH),
        _image(_DEPTH, "tiff"),
    ]
    seeds += [_image(_DEPTH.astype(np.float32), "tiff")]
    seeds += [cv2.imencode(s, np.dstack([_DEPTH] * 3))[1].tobytes() for s in (".png", ".tiff")]
    with TemporaryDirectory() as folder:
        path = Path(folder) / "a.exr"
        header = {"type": OpenEXR.scanlineimage, "compression": OpenEXR.PIZ_COMPRESSION}
        OpenEXR.File(header, {"Z": _DEPTH.astype(np.float32)}).write(str(path))
        return [*seeds, path.read_bytes()]


def _read_image(path: Path) -> None:
    suffix = {b"\x93": ".npy", b"P": ".npy", b"\x76": ".exr"}.get(path.read_bytes()[:1], ".png")
    path = path.replace(path.with_suffix(suffix))
    for indices in (True, False):
        pixels = read_pixels(path, indices=indices)
        assert pixels.ndim in (2, 3)
        assert pixels.dtype.kind in "buif"
        assert 0 not in pixels.shape
    with suppress(DataError):  # color images are not depth
        depth = read_depth_m(path, 1000.0)
        assert 0 <= depth.min() <= depth.max() <= 1e4


TARGETS: dict[str, tuple[Callable[[], list[bytes]], Callable[[Path], None]]] = {
    "label_table": (_table_seeds, _read_table),
    "classes": (_class_seeds, _read_class_list),
    "cameras": (_camera_seeds, _read_camera_list),
    "photo_cameras": (_photo_camera_seeds, _read_photo_cameras),
    "pose": (_pose_seeds, _read_pose),
    "off": (_off_seeds, _read_mesh),
    "home": (_home_seeds, _read_home),
    "gpano": (_gpano_seeds, _read_gpano),
    "pixels": (_pixel_seeds, _read_image),
}
"""By name: valid files, and a reader that asserts what comes out."""
