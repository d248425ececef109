from __future__ import annotations

import re
from collections import Counter
from pathlib import Path

from datamodules.synthrooms.generate import MANIFEST, plan_rooms
from datamodules.synthrooms.settings import RoomSettings
from tests.datamodules.conftest import TINY_ROOMS
from tests.datamodules.data_files import contents, read_png

NAME = re.compile(
    r"camera_([0-9a-f]{32})_([A-Za-z]+_\d+)_frame_(equirectangular|\d+)_domain_(\w+)\.(png|json)"
)


def test_files_are_those_of_the_real_set(tiny_rooms: Path) -> None:
    names = [Path(name) for name in contents(tiny_rooms)]
    pictures = [name for name in names if len(name.parts) > 1]
    assert {str(n) for n in names} - {str(n) for n in pictures} == {
        MANIFEST,
        "semantic_labels.json",
    }
    cameras = sum(len(plan.cameras) for plan in plan_rooms(TINY_ROOMS))
    assert len(pictures) == cameras * 2 * 4
    for path in pictures:
        match = NAME.fullmatch(path.name)
        assert match
        area, group, kind = path.parts[:3]
        assert area in {"area_1", "area_5a", "area_5b"}
        assert (match[3] == "equirectangular") == (group == "pano")
        assert match[4] == kind
        assert match[5] == ("json" if kind == "pose" else "png")
    sizes = {read_png(tiny_rooms / p).shape[:2] for p in pictures if p.suffix == ".png"}
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
