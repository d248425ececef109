"""``tangent-render``: panoramas to files and back, and everything that can be wrong with either."""

from __future__ import annotations

import json
import re
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import pytest

from tangent_train.geometry import TangentGrid, equirect_directions
from tangent_train.io.camera_files import read_cameras, read_rig
from tangent_train.io.pixel_files import read_pixels, write_pixels
from tangent_train.rendering import equirect_to_tangent, tangent_to_equirect
from tests.cli.rendering import Refused, render_with, smooth
from tests.running import Capture, Patch

_read = partial(read_pixels, indices=True)


@pytest.fixture
def room(tmp_path: Path) -> Path:
    path = tmp_path / "in" / "room.png"
    write_pixels(path, smooth())
    return path


@pytest.fixture
def rendered(room: Path, tmp_path: Path) -> Path:
    render_with(input=room, output=tmp_path / "tan", base_level=0)
    return tmp_path / "tan" / "room"


# There and back.


def test_channels_of_openexr_images(tmp_path: Path) -> None:
    path, colors = tmp_path / "a.exr", smooth().astype(np.float32)
    channels = {c: colors[..., i].copy() for i, c in enumerate("RGB")}
    depth, mist = colors.sum(-1), -colors.sum(-1)
    OpenEXR.File({}, {**channels, "Depth.Z": depth, "Mist.Z": mist}).write(str(path))
    grid = TangentGrid(0, 5)
    cases: list[tuple[dict[str, Any], Any]] = [
        ({}, colors),
        ({"interpolation": "nearest"}, depth),
        ({"depth_channel": "Mist.Z"}, mist),
    ]
    for number, (settings, expected) in enumerate(cases):
        output, kind = tmp_path / f"{number}", settings.get("interpolation", "bilinear")
        render_with(input=path, output=output, base_level=0, format="npy", **settings)
        views = np.stack([_read(file) for file in sorted((output / "a").glob("*.npy"))])
        right = equirect_to_tangent(expected, grid, interpolation=kind)
        np.testing.assert_allclose(views, right, rtol=1e-6)


@pytest.mark.parametrize(
    ("base_level", "blend", "dtype", "suffix"),
    [(0, "nearest", np.uint8, ".png"), (1, "feather", np.uint16, ".tif")],
)
def test_colors_come_back(
    tmp_path: Path, base_level: int, blend: Any, dtype: Any, suffix: str
) -> None:
    image = smooth().astype(dtype) * dtype(257 if dtype is np.uint16 else 1)
    path, output = tmp_path / f"room{suffix}", tmp_path / f"back{suffix}"
    write_pixels(path, image)
    render_with(input=path, output=tmp_path / "tan", base_level=base_level, format=suffix[1:])
    cameras = read_cameras(tmp_path / "tan" / "room" / "cameras.json")
    grid = TangentGrid(base_level, 5)
    assert (cameras.grid, cameras.shape, cameras.source) == (grid, (64, 128), path.name)
    expected = equirect_to_tangent(image, grid)
    for file, tangent in zip(cameras.files, expected, strict=True):
        np.testing.assert_array_equal(_read(tmp_path / "tan" / "room" / file), tangent)
    render_with(back=tmp_path / "tan" / "room", output=output, blend=blend)
    again = _read(output)
    assert np.abs(again / np.iinfo(dtype).max - image / np.iinfo(dtype).max).max() <= 4 / 255
    np.testing.assert_array_equal(again, tangent_to_equirect(expected, grid, (64, 128), blend))


def test_a_folder_of_panoramas_and_back_is_continued(tmp_path: Path, refused: Refused) -> None:
    for name in ("a.png", "deeper/b.jpg", "deeper/c.v2.tif"):
        write_pixels(tmp_path / "in" / name, smooth(32))
    settings = {"input": tmp_path / "in", "base_level": 0}
    # A folder that a command wrote is skipped, even within the input.
    render_with(output=tmp_path / "in" / "tan", **settings)
    (tmp_path / "in" / "tan" / "a" / "face_000.png").unlink()
    write_pixels(tmp_path / "in" / "new.png", smooth(32))
    render_with(output=tmp_path / "in" / "tan", **settings)
    assert len(list((tmp_path / "in" / "tan" / "a").iterdir())) == 20, "finished before"
    message = refused(output=tmp_path / "in" / "tan", **settings | {"base_level": 1})
    assert "base_level: found 1; expected 0, with which" in message
    assert "in, which holds other files" in refused(output=tmp_path / "in", **settings)

    message = refused(back=tmp_path / "in" / "tan", output=tmp_path / "back")
    assert re.search(r"face_000.*1 of 4 panoramas could not", message, re.DOTALL)
    back = tmp_path / "back"
    written = {path.relative_to(back).as_posix() for path in back.rglob("*.png")}
    assert written == {"deeper/b.png", "deeper/c.v2.png", "new.png"}
    for name in written:
        assert np.abs(_read(back / name).astype(int) - smooth(32)).max() <= 12


def test_labels_are_never_mixed(tmp_path: Path, refused: Refused) -> None:
    labels = np.random.default_rng(0).choice([3, 90, 200], (8, 16)).astype(np.uint8)
    labels = labels.repeat(8, axis=0).repeat(8, axis=1)
    write_pixels(tmp_path / "labels.png", labels)
    settings = {"interpolation": "nearest", "base_level": 1}
    render_with(input=tmp_path / "labels.png", output=tmp_path / "tan", **settings)
    results = tmp_path / "tan" / "labels"
    assert "found labels to back.jpg" in refused(back=results, output=tmp_path / "back.jpg")
    render_with(back=results, output=tmp_path / "back.png")
    grid = TangentGrid(1, 5)
    images = equirect_to_tangent(labels, grid, interpolation="nearest")
    expected = tangent_to_equirect(images, grid, labels.shape, interpolation="nearest")
    np.testing.assert_array_equal(_read(tmp_path / "back.png"), expected)
    assert set(np.unique(expected)) == {3, 90, 200}


@pytest.mark.parametrize("dim", [20])
def test_z_depth_of_floats_becomes_distance(rendered: Path, tmp_path: Path, dim: int) -> None:
    """Depth along the axis of a sphere around the camera, by similar triangles."""
    grid = TangentGrid(0, 5)
    line = ((np.arange(dim) + 0.5) / dim - 0.5) * grid.dim * grid.pitch
    x, y = np.meshgrid(line, line)
    depth = (2.5 / np.sqrt(x**2 + y**2 + 1)).astype(np.float32)
    depth[: dim // 2] = 0
    folder, output = tmp_path / "depth", tmp_path / "back.tif"
    for face in range(20):
        write_pixels(folder / f"face_{face:03}.tif", depth)
    render_with(back=folder, cameras=rendered / "cameras.json", output=output, z_depth=True)
    distance = _read(output)
    measured = distance > 0
    assert 0.3 < measured.mean() < 0.7, "missing depth stays missing, and spreads nowhere"
    np.testing.assert_allclose(distance[measured], 2.5, rtol=1e-6)
    render_with(back=folder, cameras=rendered, output=tmp_path / "plain.tif")
    plain = _read(tmp_path / "plain.tif")
    assert plain[measured].min() < 2.1
    assert set(np.unique(plain)) <= set(np.unique(depth))


def test_distances_beyond_the_integers_are_unknown_and_counted(
    rendered: Path, tmp_path: Path, capsys: Capture
) -> None:
    grid = TangentGrid(0, 5)
    line = (np.arange(grid.dim) - (grid.dim - 1) / 2) * grid.pitch
    x, y = np.meshgrid(line, line)
    depth = np.full((grid.dim, grid.dim), 60000, np.uint16)
    for face in range(20):
        write_pixels(tmp_path / "depth" / f"face_{face:03}.png", depth)
    output = tmp_path / "back.png"
    cameras = rendered / "cameras.json"
    render_with(back=tmp_path / "depth", cameras=cameras, output=output, z_depth=True)
    count = 20 * int((60000 * np.sqrt(x**2 + y**2 + 1) > 65535).sum())
    assert count > 0
    assert f"{count} pixels: distances beyond its integers are unknown" in capsys.readouterr().err
    distance = _read(output)
    assert distance[distance > 0].min() >= 60000


@pytest.mark.parametrize("blend", ["nearest", "feather"])
def test_level_views_come_back_in_place(tmp_path: Path, blend: str, refused: Refused) -> None:
    """Rows unlike columns; results of half the size, and directions computed from the file."""
    write_pixels(tmp_path / "room.png", smooth(64))
    views = {"option": "horizontal_economy", "fov": [110, 90], "dim": [40, 56]}
    render_with(input=tmp_path / "room.png", output=tmp_path / "level", views=views)
    render_with(back=tmp_path / "level", output=tmp_path / "colors", blend=blend)
    colors = _read(tmp_path / "colors" / "room.png").astype(int)
    assert np.abs(colors - smooth(64)).max() <= 12
    content = json.loads((tmp_path / "level" / "room" / "cameras.json").read_text())
    assert len(content["images"]) == 12
    (tmp_path / "features").mkdir()
    focal = content["camera"]["matrix"][0][0] / 2
    x, y = np.meshgrid((np.arange(28) - 13.5) / focal, (np.arange(20) - 9.5) / focal)
    for image in content["images"]:
        world = np.stack([x, y, np.ones_like(x)], axis=-1) @ np.array(image["world_from_camera"]).T
        np.save(tmp_path / "features" / f"{Path(image['file']).stem}.npy", world.astype(np.float32))
    settings = {"back": tmp_path / "features", "cameras": tmp_path / "level" / "room"}
    render_with(output=tmp_path / "back.npy", blend=blend, height=20, **settings)
    found = np.load(tmp_path / "back.npy")
    found /= np.linalg.norm(found, axis=-1, keepdims=True)
    expected = equirect_directions((20, 40)) * (1, -1, 1)  # the world has y to the left
    away = np.degrees(np.arccos((found * expected).sum(-1).clip(-1, 1)))
    assert away.max() < (0.1 if blend == "nearest" else 3)
    np.save(tmp_path / "features" / "face_003.npy", np.zeros((20, 20, 3), np.float32))
    message = refused(output=tmp_path / "no.npy", **settings)
    assert "face_003.npy: found float32 of shape (20, 20, 3)" in message
    for changes in ({"views": "erp"}, {"views": views, "base_level": 0}):
        message = refused(input=tmp_path / "room.png", output=tmp_path / "no", **changes)
        assert "views: found" in message


@pytest.mark.parametrize(
    ("settings", "count", "size"),
    [
        ({"yaw": [0, 90, 180, 270], "pitch": 0, "fov": 90, "size": [64, 48]}, 4, (48, 64)),
        ({"fov": [90, 60], "yaw": [0, 90], "level": 5}, 2, (19, 32)),
        ({"views": {"option": "horizontal", "rings": [{"pitch": 0, "views": 4}], "fov": [90, 60]}},
         4, (32, 32)),
        ({"views": "horizontal_wide"}, 16, (32, 32)),
    ],
)  # fmt: skip
def test_views_that_miss_a_direction_are_rendered_but_not_back(
    room: Path, tmp_path: Path, refused: Refused, settings: Any, count: int, size: tuple[int, int]
) -> None:
    render_with(input=room, output=tmp_path / "views", **settings)
    content = json.loads((tmp_path / "views" / "room" / "cameras.json").read_text())
    assert len(content["images"]) == count
    for image in content["images"]:
        pixels = _read(tmp_path / "views" / "room" / image["file"])
        assert pixels.shape == (*size, 3)
        camera = content["camera"] or image["camera"]
        assert (camera["height"], camera["width"]) == size
        rays = np.array(image["world_from_camera"]) @ np.linalg.inv(camera["matrix"])
        x, y, z = rays @ (3, 5, 1)  # column 3, row 5
        color = (np.array([x, -y, z]) / np.linalg.norm([x, y, z]) + 1) * 127.5
        assert np.abs(pixels[5, 3] - color).max() <= 3
    message = refused(back=tmp_path / "views", output=tmp_path / "back")
    assert "several fields of view" in message or f"{count} views that miss" in message


@pytest.mark.parametrize(
    ("rotation", "forward", "right"),
    [
        ([0, 0, 90], (1, 0, 0), (0, 0, -1)),  # clockwise: right goes down
        ([90, 90, 0], (0, 0, 1), (-1, 0, 0)),  # pitched before yawed
    ],
)
def test_yaw_pitch_roll(
    room: Path, tmp_path: Path, rotation: list[float], forward: Any, right: Any
) -> None:
    render_with(input=room, output=tmp_path / "tan", base_level=0, faces=[3], rotation=rotation)
    found = read_cameras(tmp_path / "tan" / "room" / "cameras.json").grid.rotation
    assert found is not None
    np.testing.assert_allclose(found @ (1, 0, 0), forward, atol=1e-12)
    np.testing.assert_allclose(found @ (0, 1, 0), right, atol=1e-12)


def test_a_broken_panorama_does_not_stop_the_others(tmp_path: Path, refused: Refused) -> None:
    for name in ("a.png", "c.png"):
        write_pixels(tmp_path / "in" / name, smooth(32))
    (tmp_path / "in" / "b.png").write_bytes(b"broken")
    write_pixels(tmp_path / "in" / "photo.jpg", np.zeros((30, 40, 3), np.uint8))
    message = refused(input=tmp_path / "in", output=tmp_path / "tan", base_level=0)
    assert "2 of 4 panoramas could not be rendered" in message
    assert "in/b.png" in message
    assert "in/photo.jpg: found 40 × 30 (width × height); expected 40 × 20 " in message
    assert sorted(path.parent.name for path in (tmp_path / "tan").rglob("cameras.json")) == [
        "a",
        "c",
    ]


def test_every_fourth_frame_of_a_video(tmp_path: Path) -> None:
    """Its folders have the numbers of the frames; a project for COLMAP has the same images."""
    av: Any = pytest.importorskip("av")
    path, shown = tmp_path / "in" / "walk.mp4", []
    path.parent.mkdir()
    with av.open(str(path), "w") as output:
        stream = output.add_stream("libx264rgb", rate=10, options={"crf": "0"})
        stream.height, stream.width, stream.pix_fmt = 64, 32, "rgb24"
        stream.set_display_rotation(90)
        for number in range(9):
            shown.append(np.roll(smooth(32), 3 * number, axis=1))
            stored = np.ascontiguousarray(np.rot90(shown[-1], -1))
            output.mux(stream.encode(av.VideoFrame.from_ndarray(stored, format="rgb24")))
        output.mux(stream.encode(None))
    write_pixels(tmp_path / "in" / "a.png", smooth(32))
    settings = {"input": tmp_path / "in", "every": 4, "base_level": 0, "faces": [3]}
    render_with(output=tmp_path / "tan", **settings)
    written = {file.parent.relative_to(tmp_path) for file in tmp_path.glob("tan/**/face_003.png")}
    names = ["a", "walk/000000", "walk/000004", "walk/000008"]
    assert written == {Path("tan", name) for name in names}
    masked = np.full((32, 64), 255, np.uint8)
    masked[:, :32] = 0
    write_pixels(tmp_path / "masks" / "walk" / "000004.png", masked)
    for name in ("a", "walk/000000", "walk/000008"):
        write_pixels(tmp_path / "masks" / f"{name}.png", np.full_like(masked, 255))
    render_with(output=tmp_path / "project", colmap=True, mask=tmp_path / "masks", **settings)
    rig = read_rig(tmp_path / "project" / "rig_config.json")
    files = ["a.png", *names[1:]]
    assert dict(rig.panoramas) == {
        f"{name.replace('/', '__')}.png": file for name, file in zip(names, files, strict=True)
    }
    for name, panorama in zip(names, [smooth(32), *shown[::4]], strict=True):
        (expected,) = equirect_to_tangent(panorama, TangentGrid(0, 4), [3])
        np.testing.assert_array_equal(_read(tmp_path / "tan" / name / "face_003.png"), expected)
        image = f"face_003/{name.replace('/', '__')}.png"
        np.testing.assert_array_equal(_read(tmp_path / "project" / "images" / image), expected)
        mask = _read(tmp_path / "project" / "masks" / f"{image}.png")
        assert mask.all() == (name != "walk/000004")


@pytest.mark.parametrize("colmap", [False, True])
def test_a_strip_whose_angles_are_given(tmp_path: Path, refused: Refused, colmap: bool) -> None:
    """As one whose tags are; without either, the message names settings of the command."""
    whole = smooth(32)
    whole[:8] = whole[24:] = 0
    write_pixels(tmp_path / "whole.png", whole)
    write_pixels(tmp_path / "strip.png", whole[8:24])
    settings = {"base_level": 0, "faces": [9], "colmap": colmap}
    message = refused(input=tmp_path / "strip.png", output=tmp_path / "none", **settings)
    assert "area=[west,east,south,north]" in message
    assert "tangent-predict also needs projection=perspective" in message
    area = [-180, 180, -45, 45]
    render_with(input=tmp_path / "strip.png", output=tmp_path / "strip", area=area, **settings)
    render_with(input=tmp_path / "whole.png", output=tmp_path / "whole", **settings)
    images = "images/face_009/strip.png" if colmap else "strip/face_009.png"
    again = _read(tmp_path / "strip" / images)
    expected = _read(tmp_path / "whole" / images.replace("strip", "whole"))
    np.testing.assert_array_equal(again, expected)
    message = refused(input=tmp_path / "whole.png", output=tmp_path / "no", area=area, **settings)
    assert "square pixels in area=[" in message
    if colmap:
        assert not _read(tmp_path / "strip" / "masks" / "face_009" / "strip.png.png").all()


# Refused settings.

_IN = {"input": "in", "output": "tan"}


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"output": "o"}, "found none of them; expected input=<panoramas>, back="),
        ({"input": "in"}, "Missing: output="),
        ({**_IN, "format": "gif"}, "format: found gif; expected 'png', "),
        (
            {**_IN, "interpolation": "nearest", "format": "jpg"},
            "found jpg; .* other formats change pix",
        ),
        ({"input": "in", "back": "in", "output": "a.png"}, "found input and back; expected"),
        ({"back": "in", "output": "a.png"}, r"no cameras\.json"),
    ],
)
def test_settings_that_cannot_work(
    settings: dict[str, Any], message: str, room: Path, monkeypatch: Patch, refused: Refused
) -> None:
    monkeypatch.chdir(room.parents[1])
    assert re.search(message, refused(**settings), re.DOTALL)
    assert not list(room.parents[1].glob("tan/*/*"))
