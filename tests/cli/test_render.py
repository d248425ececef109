"""``tangent-render``: panoramas to files and back, and everything that can be wrong with either."""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from omegaconf import OmegaConf

from datamodules.images import tangent_folders
from datamodules.images.pixel_files import write_pixels
from tangent_train.cli import main
from tangent_train.cli.compose import config_folder
from tangent_train.cli.render import render
from tangent_train.errors import DataError, SettingError
from tangent_train.geometry import (
    TangentGrid,
    equirect_directions,
    rotation_about,
)
from tangent_train.rendering import equirect_to_tangent, read_cameras, tangent_to_equirect

HEIGHT = 64


def _render(**settings: Any) -> None:
    config = OmegaConf.load(config_folder() / "render.yaml")
    texts = {
        key: str(value) if isinstance(value, Path) else value for key, value in settings.items()
    }
    unknown = texts.keys() - set(config)
    assert not unknown
    plain: Any = OmegaConf.to_container(OmegaConf.merge(config, texts), resolve=True)
    render(plain)


def _smooth(height: int = HEIGHT) -> NDArray[np.uint8]:
    """``(H, 2H, 3)`` RGB, smooth on the sphere; every direction has its own colour."""
    return np.rint((equirect_directions((height, 2 * height)) + 1) * 127.5).astype(np.uint8)


def _write(path: Path, image: NDArray[Any]) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    ordered = image if image.ndim == 2 else image[..., ::-1]
    assert cv2.imwrite(str(path), np.ascontiguousarray(ordered))
    return path


def _read(path: Path) -> NDArray[Any]:
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert image is not None
    return image if image.ndim == 2 else image[..., ::-1]


@pytest.fixture
def room(tmp_path: Path) -> Path:
    return _write(tmp_path / "in" / "room.png", _smooth())


# There and back.


@pytest.mark.parametrize("base_level", [0, 1])
@pytest.mark.parametrize("blend", ["nearest", "feather"])
def test_colours_come_back(room: Path, tmp_path: Path, base_level: int, blend: str) -> None:
    _render(input=room, output=tmp_path / "tan", base_level=base_level)
    cameras = read_cameras(tmp_path / "tan" / "room" / "cameras.json")
    grid = TangentGrid(base_level, 5)
    assert (cameras.grid, cameras.shape, cameras.source) == (grid, (64, 128), "room.png")
    expected = equirect_to_tangent(_smooth(), grid)
    for file, image in zip(cameras.files, expected, strict=True):
        np.testing.assert_array_equal(_read(tmp_path / "tan" / "room" / file), image)
    _render(back=tmp_path / "tan" / "room", output=tmp_path / "back.png", blend=blend)
    again = _read(tmp_path / "back.png")
    assert again.shape == (64, 128, 3)
    assert np.abs(again.astype(int) - _smooth()).max() <= 4
    np.testing.assert_array_equal(
        again,
        tangent_to_equirect(
            expected, grid, (64, 128), "feather" if blend == "feather" else "nearest"
        ),
    )


def test_the_command_line_takes_any_path(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    _write(tmp_path / "my (rooms)" / "a=b,c.png", _smooth(32))
    monkeypatch.chdir(tmp_path)
    for arguments in (
        ["input=my (rooms)/a=b,c.png", "output=out [1]", "base_level=0", "colmap=true"],
        ["back=out [1]/a=b,c", "output=back, again.png", "height=20"],
    ):
        monkeypatch.setattr(sys, "argv", ["tangent-render", *arguments])
        main.render()
    assert (tmp_path / "out [1]" / "a=b,c" / "sparse" / "images.txt").is_file()
    assert _read(tmp_path / "back, again.png").shape == (20, 40, 3)
    shown = capsys.readouterr().out
    assert "20 tangent images of 1 panorama: out [1]" in shown
    assert "Panorama: back, again.png" in shown
    assert not list(tmp_path.glob("outputs")), "Hydra leaves nothing behind"


def test_a_folder_of_panoramas_and_back(tmp_path: Path) -> None:
    for name in ("a.png", "deeper/b.jpg", "deeper/c.v2.tif"):
        _write(tmp_path / "in" / name, _smooth(32))
    # Into the folder itself: the second run does not take the images for panoramas.
    for overwrite in (False, True):
        _render(input=tmp_path / "in", output=tmp_path / "in", base_level=0, overwrite=overwrite)
    names = ["a", "deeper/b", "deeper/c.v2"]
    for name in names:
        assert len(list((tmp_path / "in" / name).iterdir())) == 21
    _render(back=tmp_path / "in", output=tmp_path / "back")
    for name in names:
        again = _read(tmp_path / "back" / f"{name}.png")
        assert np.abs(again.astype(int) - _smooth(32)).max() <= 12
    with pytest.raises(SettingError, match=r"a\.png \(and 2 more\), which exists"):
        _render(back=tmp_path / "in", output=tmp_path / "back")
    with pytest.raises(SettingError, match="expected a folder for the 3 panoramas"):
        _render(back=tmp_path / "in", output=tmp_path / "back.png")


def test_results_apart_from_the_cameras(tmp_path: Path) -> None:
    for name in ("a", "b"):
        _write(tmp_path / "in" / f"{name}.png", _smooth(32))
        for face in range(20):
            _write(
                tmp_path / "results" / name / f"face_{face:03}.png", np.full((8, 8), 7, np.uint8)
            )
    _render(input=tmp_path / "in", output=tmp_path / "tan", base_level=0)
    _render(back=tmp_path / "results", cameras=tmp_path / "tan", output=tmp_path / "back")
    for name in ("a", "b"):
        labels = _read(tmp_path / "back" / f"{name}.png")
        assert labels.shape == (32, 64)
        assert (labels == 7).all()


def test_levels_follow_the_rows_and_large_panoramas_are_averaged(tmp_path: Path) -> None:
    _write(tmp_path / "a.png", _smooth(90))
    _render(input=tmp_path / "a.png", output=tmp_path / "tan", base_level=0)
    assert read_cameras(tmp_path / "tan" / "a" / "cameras.json").grid.level == 5
    # A checkerboard of single pixels: averaged it is grey, sampled it would be black and white.
    board = np.where(np.indices((128, 256)).sum(axis=0) % 2, 255, 0)
    _write(tmp_path / "board.png", board[..., None].repeat(3, axis=2).astype(np.uint8))
    _render(input=tmp_path / "board.png", output=tmp_path / "tan", base_level=0, level=5)
    assert set(np.unique(_read(tmp_path / "tan" / "board" / "face_004.png"))) <= {127, 128}
    assert read_cameras(tmp_path / "tan" / "board" / "cameras.json").shape == (128, 256)


@pytest.mark.parametrize("dtype", [np.uint16, np.float32, np.int64, np.float16])
@pytest.mark.parametrize("channels", [(), (3,), (6,)])
def test_averaging_keeps_the_type(dtype: Any, channels: tuple[int, ...]) -> None:
    blocks = np.random.default_rng(0).random((16, 32, *channels)) * 60000
    blocks = (blocks if np.dtype(dtype).kind in "ui" else blocks / 60000).astype(dtype)
    panorama = blocks.repeat(3, axis=0).repeat(3, axis=1)
    small = tangent_folders.shrink_to_level(panorama, 3)
    assert small.dtype == dtype
    np.testing.assert_allclose(small, blocks, rtol=1e-6)
    assert tangent_folders.shrink_to_level(blocks, 3) is blocks


def test_folders_whose_names_end_like_files_come_back_apart(tmp_path: Path) -> None:
    for name in ("room.png", "room.png.png"):
        _write(tmp_path / "in" / name, _smooth(16))
    _render(input=tmp_path / "in", output=tmp_path / "tan", base_level=0)
    _render(back=tmp_path / "tan", output=tmp_path / "back")
    names = sorted(path.name for path in (tmp_path / "back").iterdir())
    assert names == ["room.png", "room.png.png"]


def test_depth_in_openexr_comes_back(room: Path, tmp_path: Path) -> None:
    OpenEXR = pytest.importorskip("OpenEXR")
    _render(input=room, output=tmp_path / "tan", base_level=0)
    cameras = read_cameras(tmp_path / "tan" / "room" / "cameras.json")
    (tmp_path / "depth").mkdir()
    for face, file in enumerate(cameras.files):
        depth = np.full((cameras.grid.dim, cameras.grid.dim), face + 1, np.float32)
        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        path = tmp_path / "depth" / f"{Path(file).stem}.exr"
        OpenEXR.File(header, {"Z": depth}).write(str(path))
    output = tmp_path / "depth.npy"
    _render(back=tmp_path / "depth", cameras=tmp_path / "tan" / "room", output=output, kind="depth")
    owners = cameras.grid.owners(equirect_directions(cameras.shape))
    assert (np.load(output, allow_pickle=False) == owners + 1).mean() > 0.999


@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_16_bits_stay(suffix: str, tmp_path: Path) -> None:
    image = _smooth().astype(np.uint16) * 257
    _write(tmp_path / f"room{suffix}", image)
    _render(
        input=tmp_path / f"room{suffix}", output=tmp_path / "tan", base_level=0, format=suffix[1:]
    )
    assert _read(tmp_path / "tan" / "room" / f"face_000{suffix}").dtype == np.uint16
    _render(back=tmp_path / "tan" / "room", output=tmp_path / f"back{suffix}")
    again = _read(tmp_path / f"back{suffix}")
    assert again.dtype == np.uint16
    assert np.abs(again.astype(int) - image).max() < 4 * 257


def test_labels_are_never_mixed(tmp_path: Path) -> None:
    labels = np.random.default_rng(0).choice([3, 90, 200], (8, 16)).astype(np.uint8)
    labels = labels.repeat(8, axis=0).repeat(8, axis=1)
    path = _write(tmp_path / "labels.png", labels)
    _render(input=path, output=tmp_path / "tan", interpolation="nearest", base_level=1)
    for name in ("back.jpg", "back.webp"):
        with pytest.raises(DataError, match="would change the labels"):
            _render(back=tmp_path / "tan" / "labels", output=tmp_path / name)
    _render(back=tmp_path / "tan" / "labels", output=tmp_path / "back.png")
    again = _read(tmp_path / "back.png")
    assert again.dtype == np.uint8
    assert set(np.unique(again)) == {3, 90, 200}
    # Two times nearest moves borders by a pixel or so; inside the blocks nothing changes.
    inside = np.zeros_like(labels, bool)
    inside.reshape(8, 8, 16, 8)[:, 3:5, :, 3:5] = True
    inside[:8], inside[-8:] = False, False  # at the poles, blocks are narrow
    assert (again == labels)[inside].all()


@pytest.mark.parametrize(
    ("value", "stored", "written"), [(300, np.int64, np.uint16), (1, np.bool_, np.uint8)]
)
def test_labels_from_arrays(
    room: Path, tmp_path: Path, value: int, stored: Any, written: Any
) -> None:
    _render(input=room, output=tmp_path / "tan", base_level=0)
    folder = tmp_path / "results"
    folder.mkdir()
    for face in range(20):
        np.save(folder / f"face_{face:03}.npy", np.full((32, 32), value, stored))
    for suffix in (".png", ".npy"):
        _render(back=folder, cameras=tmp_path / "tan" / "room", output=tmp_path / f"back{suffix}")
    image = _read(tmp_path / "back.png")
    assert image.dtype == written
    assert (image == value).all()
    array = np.load(tmp_path / "back.npy")
    assert array.dtype == stored


def _z_depth(grid: TangentGrid, radius: float) -> NDArray[np.float64]:
    """``(d, d)`` depth along the axis of a sphere around the camera, by similar triangles."""
    line = (np.arange(grid.dim) - (grid.dim - 1) / 2) * grid.pitch
    x, y = np.meshgrid(line, line)
    return np.asarray(radius / np.sqrt(x**2 + y**2 + 1))


@pytest.mark.parametrize("dim", [32, 20])
def test_z_depth_of_floats_becomes_distance(room: Path, tmp_path: Path, dim: int) -> None:
    _render(input=room, output=tmp_path / "tan", base_level=0)
    grid = TangentGrid(0, 5)
    line = ((np.arange(dim) + 0.5) / dim - 0.5) * grid.dim * grid.pitch
    x, y = np.meshgrid(line, line)
    depth = (2.5 / np.sqrt(x**2 + y**2 + 1)).astype(np.float32)
    depth[: dim // 2] = 0
    for face in range(20):
        _write(tmp_path / "depth" / f"face_{face:03}.tif", depth)
    cameras = tmp_path / "tan" / "room" / "cameras.json"
    output = tmp_path / "back.tif"
    _render(back=tmp_path / "depth", cameras=cameras, output=output, z_depth=True)
    distance = _read(output)
    assert distance.dtype == np.float32
    measured = distance > 0
    assert 0.3 < measured.mean() < 0.7, "missing depth stays missing, and spreads nowhere"
    np.testing.assert_allclose(distance[measured], 2.5, rtol=1e-6)
    _render(back=tmp_path / "depth", cameras=cameras, output=tmp_path / "plain.tif")
    plain = _read(tmp_path / "plain.tif")
    assert plain[measured].min() < 2.1
    assert set(np.unique(plain)) <= set(np.unique(depth))


def test_z_depth_of_16_bits(room: Path, tmp_path: Path) -> None:
    _render(input=room, output=tmp_path / "tan", base_level=0)
    depth = np.rint(_z_depth(TangentGrid(0, 5), 5000)).astype(np.uint16)
    depth[:10], depth[10:12] = 0, 65535
    for face in range(20):
        _write(tmp_path / "depth" / f"face_{face:03}.png", depth)
    settings = {"back": tmp_path / "depth", "cameras": tmp_path / "tan" / "room", "z_depth": True}
    _render(output=tmp_path / "back.png", **settings)
    distance = _read(tmp_path / "back.png")
    assert distance.dtype == np.uint16
    valid = (distance != 0) & (distance != 65535)
    assert np.abs(distance[valid].astype(int) - 5000).max() <= 1
    assert (distance == 0).any()
    _write(tmp_path / "depth" / "face_003.png", np.full((32, 32), 60000, np.uint16))
    with pytest.raises(DataError, match="at most 65535, which uint16 holds"):
        _render(output=tmp_path / "again.png", **settings)
    assert not (tmp_path / "again.png").exists()


@pytest.mark.parametrize("dim", [32, 16])
@pytest.mark.parametrize("blend", ["nearest", "feather"])
def test_features_of_another_resolution(
    room: Path, tmp_path: Path, dim: int, blend: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Features that are the directions of their pixels, written by hand, come back in place."""
    monkeypatch.setattr("datamodules.images.tangent_results._GROUP_BYTES", 200_000)
    _render(input=room, output=tmp_path / "tan", base_level=0)
    content = json.loads((tmp_path / "tan" / "room" / "cameras.json").read_text())
    (tmp_path / "features").mkdir()
    edge = np.tan(np.radians(content["camera"]["fov_deg"] / 2))
    line = ((np.arange(dim) + 0.5) / dim * 2 - 1) * edge
    planes = np.stack([*np.meshgrid(line, line), np.ones((dim, dim))], axis=-1)
    for image in content["images"]:
        world = planes @ np.array(image["world_from_camera"]).T
        features = np.concatenate([world, world[..., :2]], axis=-1).astype(np.float32)
        np.save(tmp_path / "features" / f"{Path(image['file']).stem}.npy", features)
    _render(
        back=tmp_path / "features",
        cameras=tmp_path / "tan" / "room" / "cameras.json",
        output=tmp_path / "back.npy",
        blend=blend,
        height=20,
    )
    panorama = np.load(tmp_path / "back.npy")
    assert (panorama.shape, panorama.dtype) == ((20, 40, 5), np.float32)
    np.testing.assert_array_equal(panorama[..., :2], panorama[..., 3:])
    # The world has y to the left, the library's directions to the right.
    expected = equirect_directions((20, 40)) * (1, -1, 1)
    found = panorama[..., :3] / np.linalg.norm(panorama[..., :3], axis=-1, keepdims=True)
    away = np.degrees(np.arccos((found * expected).sum(-1).clip(-1, 1)))
    assert away.max() < (0.1 if blend == "nearest" else 3)


@pytest.mark.parametrize("rotation", [[30, -20, 75.5], "so3"])
def test_turned_icosahedra_come_back(room: Path, tmp_path: Path, rotation: Any) -> None:
    _render(input=room, output=tmp_path / "tan", base_level=0, rotation=rotation, seed=4)
    cameras = read_cameras(tmp_path / "tan" / "room" / "cameras.json")
    assert cameras.grid.rotation is not None
    _render(back=tmp_path / "tan" / "room", output=tmp_path / "back.png")
    assert np.abs(_read(tmp_path / "back.png").astype(int) - _smooth()).max() <= 5
    _render(input=room, output=tmp_path / "again", base_level=0, rotation=rotation, seed=4)
    assert read_cameras(tmp_path / "again" / "room" / "cameras.json") == cameras


@pytest.mark.parametrize(
    ("rotation", "forward", "right"),
    [
        ([90, 0, 0], (0, 1, 0), (-1, 0, 0)),  # to the right
        ([0, 90, 0], (0, 0, 1), (0, 1, 0)),  # up
        ([0, 0, 90], (1, 0, 0), (0, 0, -1)),  # clockwise: right goes down
        ([90, 90, 0], (0, 0, 1), (-1, 0, 0)),  # pitched before yawed
    ],
)
def test_yaw_pitch_roll(
    room: Path, tmp_path: Path, rotation: list[float], forward: Any, right: Any
) -> None:
    _render(input=room, output=tmp_path / "tan", base_level=0, faces=[3], rotation=rotation)
    turn = read_cameras(tmp_path / "tan" / "room" / "cameras.json").grid.rotation
    assert turn is not None
    np.testing.assert_allclose(turn @ (1, 0, 0), forward, atol=1e-12)
    np.testing.assert_allclose(turn @ (0, 1, 0), right, atol=1e-12)


def test_some_faces_with_a_margin(room: Path, tmp_path: Path) -> None:
    _render(input=room, output=tmp_path / "tan", base_level=0, faces=[5, 0], dim=40, format="npy")
    folder = tmp_path / "tan" / "room"
    assert sorted(path.name for path in folder.iterdir()) == [
        "cameras.json",
        "face_000.npy",
        "face_005.npy",
    ]
    expected = equirect_to_tangent(_smooth(), TangentGrid(0, 5, 40), [5])
    np.testing.assert_array_equal(np.load(folder / "face_005.npy"), expected[0])
    with pytest.raises(DataError, match="cameras of 2 of the 20 images"):
        _render(back=folder, output=tmp_path / "back.png")


def test_depth_arrays_are_panoramas_too(tmp_path: Path) -> None:
    distance = np.linspace(1, 5, 32)[:, None].repeat(64, axis=1).astype(np.float32)
    np.save(tmp_path / "depth.npy", distance)
    settings = {"input": tmp_path / "depth.npy", "base_level": 0, "interpolation": "nearest"}
    with pytest.raises(DataError, match=r"depth\.npy: \.png files: found float32"):
        _render(output=tmp_path / "png", **settings)
    assert not list(tmp_path.glob("png/*"))
    _render(output=tmp_path / "tan", format="tif", **settings)
    _render(back=tmp_path / "tan" / "depth", output=tmp_path / "back.tif")
    again = _read(tmp_path / "back.tif")
    assert np.abs(again - distance).max() < 0.3
    assert set(np.unique(again)) <= set(np.unique(distance))


# A figure.


def test_a_figure_alone_or_beside_the_images(room: Path, tmp_path: Path) -> None:
    figure = tmp_path / "figure.png"
    _render(input=room, figure=figure, base_level=0)
    assert _read(figure).shape[1] == 1920
    with pytest.raises(SettingError, match=r"figure\.png, which exists"):
        _render(input=room, figure=figure, output=tmp_path / "tan")
    _write(room.with_name("second.png"), _smooth(32))
    with pytest.raises(SettingError, match="figure: found 2 panoramas"):
        _render(input=room.parent, figure=tmp_path / "other.png")
    np.save(tmp_path / "depth.npy", np.ones((32, 64)))
    with pytest.raises(DataError, match="grey or colours"):
        _render(input=tmp_path / "depth.npy", figure=tmp_path / "other.png")
    assert not (tmp_path / "other.png").exists()


# What exists, and what is interrupted.


def test_earlier_images_are_kept_unless_told(room: Path, tmp_path: Path) -> None:
    _render(input=room, output=tmp_path / "tan", base_level=1, colmap=True)
    folder = tmp_path / "tan" / "room"
    with pytest.raises(SettingError, match=r"tan/room, which exists.*overwrite=true"):
        _render(input=room, output=tmp_path / "tan")
    (folder / "notes.txt").write_text("mine")
    (folder / "sparse" / "notes.txt").write_text("mine")
    _render(input=room, output=tmp_path / "tan", base_level=0, format="jpg", overwrite=True)
    names = sorted(path.name for path in folder.iterdir())
    jpegs = [f"face_{face:03}.jpg" for face in range(20)]
    assert names == ["cameras.json", *jpegs, "notes.txt", "sparse"]
    assert [path.name for path in (folder / "sparse").iterdir()] == ["notes.txt"]
    assert not list(tmp_path.rglob(".partial*"))
    assert folder.stat().st_mode & 0o777 == 0o755


def test_an_empty_folder_is_no_earlier_result(room: Path, tmp_path: Path) -> None:
    (tmp_path / "tan" / "room").mkdir(parents=True)
    _render(input=room, output=tmp_path / "tan", base_level=0)
    assert (tmp_path / "tan" / "room" / "cameras.json").is_file()


def test_earlier_panoramas_are_kept_unless_told(room: Path, tmp_path: Path) -> None:
    _render(input=room, output=tmp_path / "tan", base_level=0)
    back = {"back": tmp_path / "tan" / "room", "output": tmp_path / "back.png"}
    (tmp_path / "back.png").write_text("mine")
    with pytest.raises(SettingError, match=r"back\.png, which exists"):
        _render(**back)
    assert (tmp_path / "back.png").read_text() == "mine"
    _render(overwrite=True, **back)
    assert _read(tmp_path / "back.png").shape == (64, 128, 3)


@pytest.mark.parametrize("overwrite", [False, True])
def test_an_interrupted_run_leaves_nothing_half_done(
    room: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, overwrite: bool
) -> None:
    if overwrite:
        _render(input=room, output=tmp_path / "tan", base_level=0)
    before = sorted(path.name for path in tmp_path.rglob("*"))

    def interrupted(path: Path, pixels: NDArray[Any]) -> None:
        if path.stem == "face_007":
            raise KeyboardInterrupt
        write_pixels(path, pixels)

    monkeypatch.setattr(tangent_folders, "write_pixels", interrupted)
    with pytest.raises(KeyboardInterrupt):
        _render(input=room, output=tmp_path / "tan", base_level=0, overwrite=overwrite)
    left = sorted(path.name for path in tmp_path.rglob("*") if path.name != "tan" or overwrite)
    assert left == before


def test_a_broken_panorama_does_not_stop_the_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("a.png", "c.png"):
        _write(tmp_path / "in" / name, _smooth(32))
    (tmp_path / "in" / "b.png").write_bytes((tmp_path / "in" / "a.png").read_bytes()[:300])
    _write(tmp_path / "in" / "photo.jpg", np.zeros((30, 40, 3), np.uint8))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["tangent-render", "input=in", "output=tan", "base_level=0"])
    with pytest.raises(SystemExit) as ended:
        main.render()
    message = str(ended.value.code)
    assert message.startswith("tangent-render: 2 of 4 panoramas could not be rendered:\n")
    assert "in/b.png" in message
    assert "in/photo.jpg: found 30×40 pixels; expected a panorama, twice as wide" in message
    done = sorted(path.name for path in (tmp_path / "tan").iterdir())
    assert done == ["a", "c"]


def test_parts_of_panoramas_by_their_tags(tmp_path: Path) -> None:
    from PIL import Image

    tags = {
        "FullPanoWidthPixels": 128,
        "FullPanoHeightPixels": 64,
        "CroppedAreaImageWidthPixels": 128,
        "CroppedAreaImageHeightPixels": 32,
        "CroppedAreaLeftPixels": 0,
        "CroppedAreaTopPixels": 16,
    }
    attributes = " ".join(f'GPano:{name}="{value}"' for name, value in tags.items())
    xmp = (
        '<x:xmpmeta xmlns:x="adobe:ns:meta/">'
        '<rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#"><rdf:Description '
        f'xmlns:GPano="http://ns.google.com/photos/1.0/panorama/" {attributes}/>'
        "</rdf:RDF></x:xmpmeta>"
    )
    Image.fromarray(_smooth()[16:48]).save(tmp_path / "part.jpg", quality=95, xmp=xmp.encode())
    _render(input=tmp_path / "part.jpg", output=tmp_path / "tan", base_level=0)
    _render(back=tmp_path / "tan" / "part", output=tmp_path / "back.png")
    again = _read(tmp_path / "back.png").astype(int)
    assert again.shape == (64, 128, 3)
    assert np.abs(again[20:44] - _smooth()[20:44]).max() < 25
    assert again[:12].max() < 10


# What is refused.


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({}, "input=<panoramas>, or back="),
        ({"input": "in"}, "output: found none"),
        ({"input": "in", "output": "tan", "base_level": -1}, "base_level"),
        ({"input": "in", "output": "tan", "base_level": "one"}, "base_level"),
        ({"input": "in", "output": "tan", "level": 0}, "level: found 0; expected .* 1 or more"),
        ({"input": "in", "output": "tan", "dim": 1.5}, "dim"),
        ({"input": "in", "output": "tan", "level": 5, "dim": 4}, "dim: found 4; expected at least"),
        ({"input": "in", "output": "tan", "faces": [80]}, "0 to 79"),
        ({"input": "in", "output": "tan", "faces": [1, 1]}, "different indices"),
        ({"input": "in", "output": "tan", "faces": []}, "different indices"),
        ({"input": "in", "output": "tan", "rotation": [1, 2]}, "yaw,pitch,roll"),
        ({"input": "in", "output": "tan", "rotation": "up"}, "yaw,pitch,roll"),
        ({"input": "in", "output": "tan", "rotation": [1, 2, float("nan")]}, "yaw,pitch,roll"),
        ({"input": "in", "output": "tan", "rotation": "so3", "seed": -1}, "seed"),
        ({"input": "in", "output": "tan", "format": "gif"}, "format: found gif; expected png"),
        ({"input": "in", "output": "tan", "interpolation": "cubic"}, "interpolation"),
        (
            {"input": "in", "output": "tan", "interpolation": "nearest", "format": "jpg"},
            "format: found jpg; .* others change pixels",
        ),
        ({"input": "in", "output": "tan", "colmap": "yes"}, "colmap: found yes; expected true"),
        ({"input": "in", "figure": "a.jpg"}, "figure"),
        ({"input": "in", "back": "tan", "output": "a.png"}, "input= as well"),
        ({"figure": "a.png", "back": "tan", "output": "a.png"}, "figure= as well"),
        ({"back": "in"}, "output: found none"),
        ({"back": "in", "output": "a.png", "blend": "mean"}, "blend"),
        ({"back": "in", "output": "a.png", "kind": "color?"}, "kind"),
        ({"back": "in", "output": "a.png", "height": 0}, "height"),
    ],
)
def test_settings_that_cannot_work(
    settings: dict[str, Any], message: str, room: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(room.parents[1])
    with pytest.raises(SettingError, match=message):
        _render(**settings)
    assert sorted(path.name for path in room.parents[1].rglob("*")) == ["in", "room.png"]


def test_names_that_would_share_a_folder(room: Path, tmp_path: Path) -> None:
    _write(room.with_suffix(".jpg"), _smooth(32))
    with pytest.raises(SettingError, match=r"room\.jpg and .*room\.png.*one by one"):
        _render(input=room.parent, output=tmp_path / "tan")


def test_nothing_to_render(room: Path, tmp_path: Path) -> None:
    with pytest.raises(DataError, match="nowhere"):
        _render(input=tmp_path / "nowhere", output=tmp_path / "tan")
    _render(input=room, output=tmp_path / "tan", base_level=0)
    with pytest.raises(DataError, match="only tangent images"):
        _render(input=tmp_path / "tan", output=tmp_path / "again")


@pytest.fixture
def rendered(room: Path, tmp_path: Path) -> Path:
    _render(input=room, output=tmp_path / "tan", base_level=0)
    return tmp_path / "tan" / "room"


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda f: (f / "face_003.png").unlink(), r"found no face_003; expected one file for each"),
        (
            lambda f: (f / "face_003.png").rename(f / "face_3.png"),
            r"no face_003, but face_3; expected",
        ),
        (lambda f: np.save(f / "face_020.npy", np.ones((4, 4))), "found face_020 as well"),
        (
            lambda f: np.save(f / "face_003.npy", np.ones((4, 4))),
            r"face_003\.npy and face_003\.png; .*folder of their own",
        ),
        (
            lambda f: _write(f / "face_003.png", np.zeros((16, 16, 3), np.uint8)),
            r"face_003\.png: found 16×16×3 of uint8; expected 32×32×3 of uint8, as face_000",
        ),
        (
            lambda f: _write(f / "face_003.png", np.zeros((32, 32), np.uint8)),
            r"face_003\.png: found 32×32 of uint8",
        ),
        (
            lambda f: _write(f / "face_003.png", np.zeros((32, 32, 3), np.uint16)),
            "of uint16; expected",
        ),
        (lambda f: _write(f / "face_000.png", np.zeros((9, 8, 3), np.uint8)), "expected a square"),
        (lambda f: (f / "face_003.png").write_bytes(b"\x89PNG"), r"face_003\.png"),
        (lambda f: (f / "cameras.json").unlink(), r"found no cameras\.json"),
        (lambda f: (f / "cameras.json").write_text("{}"), r"cameras\.json: found another kind"),
    ],
)
def test_results_that_cannot_be_used(
    damage: Any, message: str, rendered: Path, tmp_path: Path
) -> None:
    damage(rendered)
    with pytest.raises(DataError, match=message):
        _render(back=rendered, output=tmp_path / "back.png")
    assert not (tmp_path / "back.png").exists()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"kind": "labels"}, "expected labels images.*one channel"),
        ({"kind": "depth"}, "expected depth images"),
        ({"z_depth": True}, "z_depth: found true for color"),
        ({"output": "back.bmp"}, r"expected the name of a file that ends in \.png"),
        ({"output": "folder"}, "expected the name of a file"),
        ({"cameras": "nowhere.json"}, "no such file"),
        ({"back": "nowhere"}, "no such folder"),
    ],
)
def test_settings_that_do_not_fit_the_results(
    settings: dict[str, Any],
    message: str,
    rendered: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises((DataError, SettingError), match=message):
        _render(**{"back": rendered, "output": "back.png"} | settings)
    assert not list(tmp_path.glob("back*"))


@pytest.mark.parametrize(
    ("array", "suffix", "message"),
    [
        (np.ones((32, 32, 5), np.float32), ".png", r"\.png files: found float32 pixels of 5"),
        (np.ones((32, 32, 5), np.int32), ".npy", "pixels that say what they are.*kind="),
        (np.full((32, 32), -1), ".png", r"\.png files: found int8"),
        (np.ones((1, 1), np.float32), ".npy", "2 or more"),
    ],
)
def test_arrays_that_cannot_be_written(
    array: NDArray[Any], suffix: str, message: str, rendered: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "results"
    folder.mkdir()
    for face in range(20):
        np.save(folder / f"face_{face:03}.npy", array)
    with pytest.raises(DataError, match=message):
        _render(back=folder, cameras=rendered, output=tmp_path / f"back{suffix}")
    assert not list(tmp_path.glob("back*"))


def test_one_panorama_s_broken_results_do_not_stop_the_others(tmp_path: Path) -> None:
    for name in ("a", "b"):
        _write(tmp_path / "in" / f"{name}.png", _smooth(32))
    _render(input=tmp_path / "in", output=tmp_path / "tan", base_level=0)
    (tmp_path / "tan" / "a" / "face_019.png").unlink()
    with pytest.raises(DataError, match=r"1 of 2 panoramas could not be rendered:\n.*face_019"):
        _render(back=tmp_path / "tan", output=tmp_path / "back")
    assert [path.name for path in (tmp_path / "back").iterdir()] == ["b.png"]


def test_the_python_of_the_docs_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    page = Path(__file__).resolve().parents[2] / "docs" / "rendering.md"
    first, second = re.findall(r"```python\n(.*?)```", page.read_text(), re.DOTALL)
    monkeypatch.chdir(tmp_path)
    _write(Path("room.png"), _smooth())
    _render(input="room.png", output="tangent", base_level=0)
    Path("results/room").mkdir(parents=True)
    for face in range(20):
        np.save(f"results/room/face_{face:03}.npy", np.full((32, 32), face))
    names: dict[str, Any] = {}
    exec(first, names)
    # The pixel of image 0 that the example asks about, in the image itself.
    left, up = np.radians([names["left_deg"], names["up_deg"]])
    direction = np.cos(up) * np.cos(left), -np.cos(up) * np.sin(left), np.sin(up)
    shown = _read(Path("tangent/room/face_000.png"))[20, 10]
    assert np.abs(shown - (np.array(direction) + 1) * 127.5).max() < 4
    exec(second, names)
    owners = TangentGrid(0, 5).owners(equirect_directions((64, 128)))
    assert (names["panorama"] == owners).mean() > 0.99


def test_a_turn_about_the_vertical_moves_the_images_along(room: Path, tmp_path: Path) -> None:
    """The figure of the convention: yaw turns the icosahedron, so its images show what is there."""
    _render(input=room, output=tmp_path / "tan", base_level=0, faces=[4], rotation=[72, 0, 0])
    _render(input=room, output=tmp_path / "plain", base_level=0)
    turned = read_cameras(tmp_path / "tan" / "room" / "cameras.json").grid
    plain = TangentGrid(0, 5)
    target = rotation_about((0, 0, 1), np.radians(72)) @ plain.centers_xyz[4]
    face = int(plain.owners(target))
    np.testing.assert_allclose(turned.centers_xyz[4], target, atol=1e-12)
    moved = _read(tmp_path / "tan" / "room" / "face_004.png").astype(int)
    there = _read(tmp_path / "plain" / "room" / f"face_{face:03}.png")
    assert np.abs(moved - there).max() <= 1
