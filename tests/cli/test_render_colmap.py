"""Projects for COLMAP, read by COLMAP: rigs, cameras and masks."""

from __future__ import annotations

import json
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from PIL import Image

from tangent_train.geometry import (
    PinholeGrid,
    RingGrid,
    TangentGrid,
    random_rotation,
    to_right_handed,
)
from tangent_train.io.camera_files import read_rig
from tangent_train.io.pixel_files import read_pixels, write_pixels
from tangent_train.keypoints.colmap import poses_from
from tests.cli.rendering import Refused, render_with, smooth
from tests.datamodules.data_files import contents, gpano_xmp
from tests.geometry.directions import angle_deg, random_directions

pycolmap = pytest.importorskip("pycolmap")
pycolmap.logging.minloglevel = 2
NAMES = ("hall/room.png", "kitchen/room.png")
RINGS = ((0, 8), (40, 5), (-40, 5))
FRAMES = ("hall__room.png", "kitchen__room.png")


@pytest.fixture
def panoramas(tmp_path: Path) -> Path:
    for name in NAMES:
        write_pixels(tmp_path / "in" / name, smooth())
    return tmp_path / "in"


VIEWS: dict[str, tuple[dict[str, Any], PinholeGrid]] = {
    "tangent": ({"base_level": 0}, TangentGrid(0, 5)),
    "horizontal": (
        {"views": {"option": "horizontal", "fov": [110, 100]}},
        RingGrid([{"pitch": p, "views": n} for p, n in RINGS], (110, 100), (40, 40)),
    ),
}


@pytest.fixture(params=["tangent"])
def views(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture
def project(panoramas: Path, tmp_path: Path, views: str) -> Path:
    settings = VIEWS[views][0] | {"rotation": [30, 10, 5]}
    render_with(input=panoramas, output=tmp_path / "project", colmap=True, **settings)
    return tmp_path / "project"


def _database(project: Path) -> Any:
    """COLMAP's database of the images, one camera a folder, with the rig."""
    path = project.parent / "database.db"
    pycolmap.Database.open(path).close()
    pycolmap.import_images(path, project / "images", pycolmap.CameraMode.PER_FOLDER)
    database = pycolmap.Database.open(path)
    rig = pycolmap.read_rig_config(project / "rig_config.json")
    pycolmap.apply_rig_config(rig, database)
    return database


def _grid(project: Path, resting: PinholeGrid = TangentGrid(0, 5)) -> PinholeGrid:  # noqa: B008
    """The images by the matrix of the first camera: all are turned as a whole."""
    first = next(iter(read_rig(project / "rig_config.json").world_from_camera.values()))
    return resting.with_rotation(to_right_handed((first @ resting.world_from_camera[0].T).T).T)


# Rigs and cameras.


@pytest.mark.parametrize("views", VIEWS, indirect=True)
def test_directions_are_where_colmap_projects_them(project: Path, views: str) -> None:
    """Two frames of one rig; 500 directions in all views of both panoramas."""
    grid = _grid(project, VIEWS[views][1])
    count, (height, width) = grid.num_images, grid.size
    directions = random_directions(500)
    with _database(project) as database:
        (rig,) = database.read_all_rigs()
        assert (rig.num_sensors(), database.num_frames(), database.num_images()) == (
            count,
            2,
            2 * count,
        )
        frames: dict[str, list[int]] = {}
        for frame in database.read_all_frames():
            images = [database.read_image(data.id) for data in frame.data_ids]
            (name,) = {image.name.partition("/")[2] for image in images}
            frames[name] = sorted(int(image.name[5:8]) for image in images)
            for image in images:
                face = int(image.name[5:8])
                camera = database.read_camera(image.camera_id)
                assert (camera.model.name, camera.width, camera.height) == (
                    "PINHOLE",
                    width,
                    height,
                )
                assert camera.has_prior_focal_length
                sensor = camera.sensor_id
                is_first = rig.is_ref_sensor(sensor)
                from_rig = pycolmap.Rigid3d() if is_first else rig.sensor_from_rig(sensor)
                assert (from_rig.translation == 0).all()
                # The rig's axes are those of the first camera.
                rays = directions @ grid.world_from_camera[0] @ from_rig.rotation.matrix().T
                seen = rays[:, 2] > 0.1
                found = camera.img_from_cam(rays[seen])
                expected = grid.project(directions[seen], np.full(seen.sum(), face))
                np.testing.assert_allclose(found - 0.5, expected, atol=1e-9)
                # The pixel itself shows that direction.
                columns, rows = np.floor(found).astype(int).T
                inside = ((np.floor(found) >= 0) & (np.floor(found) < (width, height))).all(axis=1)
                shown = read_pixels(project / "images" / image.name, indices=False)
                colors = shown[rows[inside], columns[inside]] / 127.5 - 1
                away = angle_deg(colors, directions[seen][inside])
                assert len(away) > 20
                assert away.max() < 5  # a pixel's diagonal and the rounding of colors
                assert away.mean() < 2
        assert frames == {name: list(range(count)) for name in FRAMES}


def test_sizes_differ_and_one_is_broken(panoramas: Path, tmp_path: Path, refused: Refused) -> None:
    write_pixels(panoramas / "large.png", smooth(128))
    (panoramas / "broken.png").write_bytes(b"broken")
    settings = {"input": panoramas, "colmap": True, "base_level": 0, "faces": [7, 2]}
    message = refused(output=tmp_path / "tan", **settings)
    assert "in/broken.png: found no image" in message
    assert "1 of 4 panoramas could not be rendered" in message
    files = {(path.parent.name, path.name): path for path in tmp_path.glob("tan/images/*/*")}
    assert files.keys() == set(product(("face_002", "face_007"), (*FRAMES, "large.png")))
    for file in files.values():
        assert read_pixels(file, indices=False).shape == (64, 64, 3)
    with _database(tmp_path / "tan") as database:
        assert (database.num_frames(), database.num_rigs()) == (3, 1)


# Masks.


def test_masks_by_name_and_classes_to_ignore(
    panoramas: Path, tmp_path: Path, refused: Refused
) -> None:
    labels = np.zeros((32, 64), np.uint8)
    labels[:, :20], labels[:, 20:50] = 1, 3
    (tmp_path / "labeled").mkdir()
    (tmp_path / "labeled" / "classes.json").write_text('{"wall": 1, "sky": 2, "person": 3}')
    for name, stored in zip(NAMES, (labels, labels[:, ::-1]), strict=True):
        write_pixels(tmp_path / "labeled" / "labels" / name, stored)
        write_pixels(tmp_path / "masks" / name, (stored != 3).astype(np.uint8))
    settings = {"input": panoramas, "base_level": 0, "colmap": True}
    render_with(output=tmp_path / "by_name", mask=tmp_path / "masks", **settings)
    settings["mask"] = tmp_path / "labeled"
    render_with(output=tmp_path / "by_class", mask_classes=["person", "sky"], **settings)
    by_name, by_class = (contents(tmp_path / name / "masks") for name in ("by_name", "by_class"))
    assert by_name == by_class
    first, second = (by_name[f"face_004/{name}.png"] for name in FRAMES)
    assert first != second
    message = refused(output=tmp_path / "no", mask_classes=["tripod"], **settings)
    assert "mask_classes: found tripod; expected of wall, sky, person" in message
    (tmp_path / "labeled" / "labels" / NAMES[1]).unlink()
    message = refused(output=tmp_path / "some", mask_classes=["person"], **settings)
    assert "labels/kitchen/room.png: found no such file; expected a mask" in message
    assert list(read_rig(tmp_path / "some" / "rig_config.json").panoramas.values()) == [NAMES[0]]


def test_the_missing_part_of_a_panorama_is_ignored(tmp_path: Path) -> None:
    tags = {"FullPanoWidth": 128, "FullPanoHeight": 64, "CroppedAreaLeft": 0, "CroppedAreaTop": 16}
    tags |= {"CroppedAreaImageWidth": 128, "CroppedAreaImageHeight": 32}
    xmp = gpano_xmp({f"{name}Pixels": value for name, value in tags.items()})
    Image.fromarray(smooth()[16:48]).save(tmp_path / "part.jpg", xmp=xmp)
    write_pixels(tmp_path / "white.png", np.full((32, 128), 255, np.uint8))
    settings = {"input": tmp_path / "part.jpg", "base_level": 0, "colmap": True}
    render_with(output=tmp_path / "out", **settings)
    render_with(output=tmp_path / "masked", mask=tmp_path / "white.png", **settings)
    assert contents(tmp_path / "masked" / "masks") == contents(tmp_path / "out" / "masks")
    grid = TangentGrid(0, 5)
    for face, directions in enumerate(grid.directions()):
        path = tmp_path / "out" / "masks" / f"face_{face:03}" / "part.png.png"
        counts = read_pixels(path, indices=True) == 255
        latitude_deg = np.abs(np.degrees(np.arcsin(directions[..., 2])))
        assert (counts | (latitude_deg > 43.5)).all()
        assert (~counts | (latitude_deg < 46.5)).all()


# Poses.


POINTS = np.random.default_rng(6).normal(0, 3, (50, 3))


def _write_model(project: Path, folder: Path) -> dict[str, tuple[Any, Any]]:
    """Write a model with `POINTS`; return axes and location of its panoramas by file."""
    first = json.loads((project / "rig_config.json").read_text())[0]["cameras"][0]
    rng = np.random.default_rng(5)
    model, true = pycolmap.Reconstruction(), {}
    with _database(project) as database:
        for camera in database.read_all_cameras():
            model.add_camera(camera)
        (rig,) = database.read_all_rigs()
        model.add_rig(rig)
        for frame in database.read_all_frames():
            images = [database.read_image(data.id) for data in frame.data_ids]
            axes, location = random_rotation(rng), rng.normal(size=3)
            from_world = (axes @ np.array(first["world_from_camera"])).T
            motion = np.column_stack([from_world, -from_world @ location])
            frame.rig_from_world = pycolmap.Rigid3d(motion)
            model.add_frame(frame)
            for image in images:
                model.add_image(image)
            model.register_frame(frame.frame_id)
            true[images[0].name.partition("/")[2].replace("__", "/")] = axes, location
    for point in POINTS:
        model.add_point3D(point, pycolmap.Track(), np.array([10, 20, 30], np.uint8))
    folder.mkdir()
    model.write(folder)
    return true


def test_poses_of_panoramas_are_those_of_their_images(project: Path, tmp_path: Path) -> None:
    """A model whose panoramas stand where we say: x to the middle column, y to its left, z up."""
    true = _write_model(project, tmp_path / "model")
    found = poses_from(tmp_path / "model", project)
    assert found.keys() == true.keys() == set(NAMES)
    directions = random_directions(20)
    for name, (axes, location) in true.items():
        points = found[name][0].points_m(directions, 3.0)
        # In this package y is to the right of the middle column.
        expected = location + 3 * (directions * (1, -1, 1)) @ axes.T
        np.testing.assert_allclose(points, expected, atol=1e-9)


def test_a_model_gives_poses_and_points_to_nerfstudio(
    project: Path, panoramas: Path, tmp_path: Path
) -> None:
    true = _write_model(project, tmp_path / "model")
    given = {"poses": tmp_path / "model", "cameras": project, "base_level": 0, "faces": [3]}
    render_with(input=panoramas, output=tmp_path / "splat", nerfstudio=True, **given)
    content = json.loads((tmp_path / "splat" / "transforms.json").read_text())
    for frame, name in zip(content["frames"], FRAMES, strict=True):
        assert frame["file_path"] == f"images/face_003/{name}"
        location = np.array(frame["transform_matrix"])[:3, 3]
        np.testing.assert_allclose(location, true[name.replace("__", "/")][1], atol=1e-9)
    cloud = trimesh.load(tmp_path / "splat" / content["ply_file_path"])
    order = np.argsort(cloud.vertices[:, 0])
    np.testing.assert_allclose(cloud.vertices[order], POINTS[np.argsort(POINTS[:, 0])], atol=1e-6)
    assert (cloud.colors[:, :3] == (10, 20, 30)).all()
