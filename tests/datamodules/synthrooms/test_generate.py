from __future__ import annotations

import json
import re
import time
from collections import Counter
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from datamodules.synthrooms import generate
from datamodules.synthrooms.generate import MANIFEST, generate_rooms, make_room, plan_rooms
from datamodules.synthrooms.settings import RoomSettings
from tangent_train.errors import DataError, SettingError
from tangent_train.geometry import equirect_directions, lonlat_to_equirect, xyz_to_lonlat

TINY = RoomSettings(
    seed=3,
    rooms={"1": 2, "5a": 1, "5b": 1},
    height=16,
    views_per_camera=1,
    view_size=8,
    supersample=1,
)
# Seed 6's first room has two cameras.
TRUE = RoomSettings(seed=6, rooms={"2": 1}, height=256, views_per_camera=3, view_size=128)
NAME = re.compile(
    r"camera_([0-9a-f]{32})_([A-Za-z]+_\d+)_frame_(equirectangular|\d+)_domain_(\w+)\.(png|json)"
)


def read_png(path: Path) -> NDArray[Any]:
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert image is not None
    return image


def contents(root: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(root)): path.read_bytes()
        for path in sorted(root.rglob("*"))
        if path.is_file()
    }


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("data") / "tiny"
    generate_rooms(root, TINY, workers=0, progress=False)
    return root


@pytest.fixture
def copy(tiny: Path, tmp_path: Path) -> Path:
    root = tmp_path / "copy"
    for name, content in contents(tiny).items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_bytes(content)
    return root


def test_files_are_those_of_the_real_set(tiny: Path) -> None:
    names = [Path(name) for name in contents(tiny)]
    pictures = [name for name in names if len(name.parts) > 1]
    assert {str(n) for n in names} - {str(n) for n in pictures} == {
        MANIFEST,
        "semantic_labels.json",
    }
    cameras = sum(len(plan.cameras) for plan in plan_rooms(TINY))
    assert len(pictures) == cameras * 2 * 4
    for path in pictures:
        match = NAME.fullmatch(path.name)
        assert match
        area, group, kind = path.parts[:3]
        assert area in {"area_1", "area_5a", "area_5b"}
        assert (match[3] == "equirectangular") == (group == "pano")
        assert match[4] == kind
        assert match[5] == ("json" if kind == "pose" else "png")
    sizes = {read_png(tiny / p).shape[:2] for p in pictures if p.suffix == ".png"}
    assert sizes == {(16, 32), (8, 8)}


def test_rooms_of_5a_and_5b_are_numbered_as_one_area() -> None:
    assert [plan.name.number for plan in plan_rooms(TINY)] == [1, 2, 1, 2]


def test_one_to_three_cameras_in_a_room() -> None:
    counts = Counter(len(plan.cameras) for plan in plan_rooms(RoomSettings(rooms={"1": 800})))
    assert set(counts) == {1, 2, 3}
    assert 0.2 < (counts[2] + counts[3]) / 800 < 0.3


@pytest.mark.slow  # the processes import torch with the package
def test_the_same_bytes_for_any_number_of_processes(tiny: Path, tmp_path: Path) -> None:
    generate_rooms(tmp_path / "same", TINY, workers=2, progress=True)
    assert contents(tmp_path / "same") == contents(tiny)


def test_another_seed_gives_other_cameras() -> None:
    other = RoomSettings(**{**TINY.as_dict(), "seed": 4})
    assert not {plan.cameras for plan in plan_rooms(other)} & {p.cameras for p in plan_rooms(TINY)}


def test_finished_rooms_are_kept_and_found_quickly(copy: Path) -> None:
    before = {path: path.stat().st_mtime_ns for path in copy.rglob("*") if path.is_file()}
    start = time.perf_counter()
    generate_rooms(copy, TINY)
    assert time.perf_counter() - start < 0.2
    assert {path: path.stat().st_mtime_ns for path in before} == before


@pytest.mark.parametrize("kind", ["rgb", "depth", "semantic", "pose"])
@pytest.mark.parametrize("damage", ["removed", "halved", "empty"])
def test_missing_and_broken_files_are_made_again(
    tiny: Path, copy: Path, kind: str, damage: str
) -> None:
    file = sorted((copy / "area_5a/pano" / kind).iterdir())[0]
    if damage == "removed":
        file.unlink()
    else:
        content = file.read_bytes()
        file.write_bytes(content[: len(content) // 2] if damage == "halved" else b"")
    generate_rooms(copy, TINY, workers=1, progress=False)
    assert contents(copy) == contents(tiny)


def test_a_missing_label_table_is_written_again(tiny: Path, copy: Path) -> None:
    (copy / "semantic_labels.json").unlink()
    generate_rooms(copy, TINY, workers=1, progress=False)
    assert contents(copy) == contents(tiny)


def test_an_interrupt_leaves_whole_files_and_work_goes_on(
    tiny: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root = tmp_path / "interrupted"
    written: list[Path] = []

    def interrupted(path: Path, content: bytes) -> None:
        if len(written) == 5:
            raise KeyboardInterrupt
        written.append(path)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)

    with monkeypatch.context() as patch:
        patch.setattr(generate, "write_bytes", interrupted)
        with pytest.raises(KeyboardInterrupt):
            generate_rooms(root, TINY, workers=1, progress=False)
    whole = contents(tiny)
    left = contents(root)
    assert len(left) < len(whole)
    assert left.items() <= whole.items()
    generate_rooms(root, TINY, workers=1, progress=False)
    assert contents(root) == whole


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "found seed=3; expected seed=9. Name another folder"),
        ('{"generator": "SynthRooms", "version": 0, "settings": {}}', "version=0"),
        ('["something"]', "found something else"),
        ("{half", "found something else"),
    ],
)
def test_a_folder_of_other_settings_is_left_alone(
    copy: Path, content: str | None, message: str
) -> None:
    if content is not None:
        (copy / MANIFEST).write_text(content)
    before = contents(copy)
    with pytest.raises(DataError, match=re.escape(message)):
        generate_rooms(copy, RoomSettings(**{**TINY.as_dict(), "seed": 9}))
    assert contents(copy) == before


def test_foreign_folders_and_files_are_left_alone(tmp_path: Path) -> None:
    real = tmp_path / "stanford2d3ds"
    (real / "area_1/pano/rgb").mkdir(parents=True)
    with pytest.raises(DataError, match=r"not SynthRooms' .*area_1"):
        generate_rooms(real, TINY)
    assert contents(tmp_path) == {}
    file = tmp_path / "file"
    file.write_text("mine")
    with pytest.raises(DataError, match="found a file; expected a folder"):
        generate_rooms(file, TINY)


def test_a_negative_number_of_workers_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SettingError, match="workers: found -1"):
        generate_rooms(tmp_path, TINY, workers=-1)
    assert contents(tmp_path) == {}


class Shot(NamedTuple):
    """A picture read back from its files."""

    rgb: NDArray[Any]
    depth_m: NDArray[Any]
    label: NDArray[Any]
    pose: dict[str, Any]
    points: NDArray[Any]


def read(file: Path) -> Shot:
    """Read by the formulas in the generator's documentation, and by nothing else of it."""
    images = {}
    for kind in ("rgb", "depth", "semantic"):
        path = file.parents[1] / kind / file.name.replace("_rgb.", f"_{kind}.")
        images[kind] = read_png(path)
    pose_file = file.parents[1] / "pose" / file.name.replace("_rgb.png", "_pose.json")
    pose = json.loads(pose_file.read_text())
    depth = np.where(images["depth"] == 65535, np.nan, images["depth"] / 512)
    blue, green, red = np.moveaxis(images["semantic"].astype(int), -1, 0)
    R = np.array(pose["camera_rt_matrix"])[:, :3]
    if pose["frame_num"] == "equirectangular":
        x, y, z = np.moveaxis(equirect_directions(depth.shape), -1, 0)
        rays = np.stack([y, -z, x], axis=-1)
    else:
        K = np.array(pose["camera_k_matrix"]) - np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
        size = depth.shape
        pixels = np.stack([*np.meshgrid(np.arange(size[1]), np.arange(size[0])), np.ones(size)], -1)
        rays = pixels @ np.linalg.inv(K).T
    points = np.array(pose["camera_location"]) + depth[..., None] * (rays @ R)
    return Shot(images["rgb"][..., ::-1], depth, red * 65536 + green * 256 + blue, pose, points)


def panorama_pixels(points: NDArray[Any], panorama: Shot) -> NDArray[Any]:
    """Where points of the room appear in a panorama, ``(..., 2)`` column and row."""
    rt = np.array(panorama.pose["camera_rt_matrix"])
    right, down, forward = np.moveaxis(points @ rt[:, :3].T + rt[:, 3], -1, 0)
    sphere = np.stack([forward, right, -down], axis=-1)
    return lonlat_to_equirect(xyz_to_lonlat(sphere), panorama.depth_m.shape)


def at_nearest(image: NDArray[Any], pixels: NDArray[Any]) -> NDArray[Any]:
    column, row = np.rint(pixels).astype(int).T
    return image[np.clip(row, 0, len(image) - 1), column % image.shape[1]]


@pytest.fixture(scope="module")
def shots(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[list[Shot]]]:
    """Panoramas, and the views of each."""
    root = tmp_path_factory.mktemp("data") / "true"
    (plan,) = plan_rooms(TRUE)
    assert len(plan.cameras) == 2
    generate_rooms(root, TRUE, workers=0, progress=False)
    files = [
        [root / camera._replace(frame=frame).file("rgb") for frame in (None, 0, 1, 2)]
        for camera in plan.cameras
    ]
    return {"cameras": [[read(file) for file in camera] for camera in files]}


def away_from_edges(panorama: Shot) -> NDArray[Any]:
    """Pixels whose neighbours within two pixels have the same label and about the same colour."""
    rgb = np.ascontiguousarray(panorama.rgb)
    label = panorama.label.astype(np.float32)
    kernel = np.ones((5, 5), np.uint8)
    same = cv2.dilate(label, kernel) == cv2.erode(label, kernel)
    contrast = cv2.dilate(rgb, kernel).astype(int) - cv2.erode(rgb, kernel)
    return (same & (contrast.max(axis=-1) < 80)).astype(bool)


def test_views_show_what_the_panorama_shows(shots: dict[str, list[list[Shot]]]) -> None:
    compared = 0
    for panorama, *views in shots["cameras"]:
        calm = away_from_edges(panorama)
        for view in views:
            seen = ~np.isnan(view.depth_m)
            pixels = panorama_pixels(view.points[seen], panorama)
            inner = at_nearest(calm, pixels)
            same = at_nearest(panorama.label, pixels) == view.label[seen]
            assert same[inner].mean() > 0.99
            near = pixels[inner].astype(np.float32)[None]
            shown = cv2.remap(
                panorama.rgb,
                near[..., 0],
                near[..., 1],
                cv2.INTER_LINEAR,
                borderMode=cv2.BORDER_WRAP,
            )[0]
            error = np.mean((shown.astype(float) - view.rgb[seen][inner]) ** 2)
            assert 10 * np.log10(255**2 / error) > 28
            compared += int(inner.sum())
    assert compared > 20_000


def test_two_cameras_agree_where_things_are(shots: dict[str, list[list[Shot]]]) -> None:
    (first, *_), (second, *_) = shots["cameras"]
    seen = ~np.isnan(first.depth_m) & away_from_edges(first)
    points = first.points[seen]
    pixels = panorama_pixels(points, second)
    other = at_nearest(second.points, pixels)
    away = np.linalg.norm(points - np.array(second.pose["camera_location"]), axis=-1)
    distance = at_nearest(second.depth_m, pixels)
    both = np.abs(distance - away) < 0.02 * away  # the others are hidden from the second camera
    assert both.mean() > 0.3
    labels = at_nearest(second.label, pixels)
    assert (labels == first.label[seen])[both].mean() > 0.99
    error = np.linalg.norm(other - points, axis=-1)[both]
    assert np.median(error / away[both]) < np.pi / TRUE.height  # one pixel


def test_a_room_is_made_the_same_alone(tiny: Path, tmp_path: Path) -> None:
    plan = plan_rooms(TINY)[2]
    make_room(tmp_path, TINY, plan.name)
    assert contents(tmp_path).items() <= contents(tiny).items()
