from __future__ import annotations

import re
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import pytest
from numpy.typing import NDArray

from datamodules.synthrooms.generate import MANIFEST, generate_rooms, plan_rooms
from datamodules.synthrooms.settings import RoomSettings
from tangent_train.errors import DataError, SettingError

TINY = RoomSettings(
    seed=3,
    rooms={"1": 2, "5a": 1, "5b": 1},
    height=16,
    views_per_camera=1,
    view_size=8,
    supersample=1,
)
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


def test_one_to_three_cameras_in_a_room() -> None:
    counts = Counter(len(plan.cameras) for plan in plan_rooms(RoomSettings(rooms={"1": 800})))
    assert set(counts) == {1, 2, 3}
    assert 0.2 < (counts[2] + counts[3]) / 800 < 0.3


def test_rooms_have_as_many_cameras_as_wanted_and_are_the_same_rooms() -> None:
    usual = plan_rooms(RoomSettings(rooms={"1": 50}))
    more = plan_rooms(RoomSettings(rooms={"1": 50}, least_cameras=2))
    for one, other in zip(usual, more, strict=True):
        assert (one.name, one.area) == (other.name, other.area)
        assert len(other.cameras) == max(2, len(one.cameras))
        assert other.cameras[: len(one.cameras)] == one.cameras


def test_finished_rooms_are_kept(copy: Path) -> None:
    before = {path: path.stat().st_mtime_ns for path in copy.rglob("*") if path.is_file()}
    generate_rooms(copy, TINY)
    assert {path: path.stat().st_mtime_ns for path in before} == before


@pytest.mark.parametrize("name", ["area_5a/pano/*/*_depth.png", "area_1/data/*/*_pose.json"])
def test_missing_files_are_made_again(tiny: Path, copy: Path, name: str) -> None:
    next(copy.glob(name)).unlink()
    (copy / "semantic_labels.json").unlink()
    generate_rooms(copy, TINY, workers=1, progress=False)
    assert contents(copy) == contents(tiny)


def test_folders_of_other_settings_and_of_others_are_left_alone(copy: Path, tmp_path: Path) -> None:
    before = contents(copy)
    with pytest.raises(DataError, match=r"found seed=3; expected seed=9\. Name another"):
        generate_rooms(copy, replace(TINY, seed=9))
    with pytest.raises(SettingError, match="workers: found -1"):
        generate_rooms(copy, TINY, workers=-1)
    assert contents(copy) == before
    (tmp_path / "real" / "area_1").mkdir(parents=True)
    with pytest.raises(DataError, match=r"not SynthRooms' .*area_1"):
        generate_rooms(tmp_path / "real", TINY)
