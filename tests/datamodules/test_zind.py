"""ZInD as a data set: which panoramas, which splits, which labels, which errors."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from datamodules.core.files import SPLITS
from datamodules.zind.panoramas import Zind, ZindPairs
from tangent_train.errors import DataError, SettingError
from tangent_train.geometry import equirect_directions
from tangent_train.rendering import EquirectRepresentation
from tests.datamodules.data_files import names_of
from tests.datamodules.zind_format import (
    CORNERED,
    METERS,
    SCALE,
    Camera,
    brute_force_labels,
    write_home,
    write_homes,
)

ERP = EquirectRepresentation(level=4)
ROOM = "000/floor_01/complete_room_01/partial_room_01"


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return write_homes(tmp_path / "zind")


def _zind(root: Path, representation: EquirectRepresentation = ERP, **settings: Any) -> Zind:
    return Zind(root, representation, num_workers=0, **settings)


def _record(root: Path, room: int, name: str) -> Any:
    content = json.loads((root / "000" / "zind_data.json").read_text())
    return content["merger"]["floor_01"][f"complete_room_{room:02}"][f"partial_room_{room:02}"][
        name
    ]


@pytest.mark.parametrize(("level", "shape"), [(4, (32, 64)), (5, (64, 128))])
def test_labels_are_cast_at_the_size_of_the_run(
    root: Path, level: int, shape: tuple[int, int]
) -> None:
    source = _zind(root, EquirectRepresentation(level=level), test_fraction=1).dataset("test")
    rooms = {"pano_1": 1, "pano_2": 1, "pano_3": 2, "pano_5": 2, "pano_4": 3, "pano_6": 4}
    assert [source.name(k).rpartition("/")[2] for k in range(len(source))] == list(rooms)
    for index, (name, room) in enumerate(rooms.items()):
        record = _record(root, room, name)
        expected = brute_force_labels(record["layout_visible"], record["ceiling_height"] - 1, shape)
        np.testing.assert_array_equal(source.read(index).labels, expected)
    picture = np.array(Image.open(root / "000" / _record(root, 1, "pano_1")["image_path"]))
    if level == 5:
        np.testing.assert_array_equal(source.read(0).rgb, picture)


def test_no_room_is_in_two_splits(root: Path) -> None:
    data = _zind(root, test_fraction=0.3, val_fraction=0.3, seed=5)
    rooms = [{n.rpartition("/")[0] for n in names_of(data, split)} for split in SPLITS]
    assert all(rooms)
    assert sum(map(len, rooms)) == len(set.union(*rooms)) == 4
    again = _zind(root, test_fraction=0.3, val_fraction=0.3, seed=6)
    assert [names_of(data, s) for s in SPLITS] == [names_of(again, s) for s in SPLITS]
    drawn = {
        tuple(names_of(_zind(root, test_fraction=0.3, split_seed=seed), "test"))
        for seed in range(5)
    }
    assert len(drawn) > 1


def test_the_partition_of_the_release_decides(root: Path) -> None:
    write_homes(root, ["001", "002"])
    partition = root / "zind_partition.json"
    partition.write_text(json.dumps({"train": ["002", "9"], "val": ["000"], "test": ["001"]}))
    data = _zind(root)
    homes = [{n.partition("/")[0] for n in names_of(data, split)} for split in SPLITS]
    assert homes == [{"002"}, {"000"}, {"001"}]
    assert not names_of(_zind(root, val_fraction=0), "val")


def test_doors_may_be_unknown(root: Path) -> None:
    labels, ignored = (
        _zind(root, doors=doors, test_fraction=1).dataset("test").read(0).labels
        for doors in ("class", "ignore")
    )
    assert (labels == 4).any()
    np.testing.assert_array_equal(ignored, np.where(labels == 4, 0, labels))


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"camera_height": None}, "pano_1.camera_height=null, not a valid number"),
        ({"image_path": "../other.jpg"}, "image_path=.*pattern"),
    ],
)
def test_a_broken_home_is_named_with_its_place(
    root: Path, change: dict[str, Any], expected: str
) -> None:
    _change(root, change)
    with pytest.raises(DataError, match=rf"000/zind_data\.json: found .*{expected}"):
        _zind(root).setup()
    assert _zind(root).check()[0].items == {"000"}


def test_a_room_without_the_camera_is_left_out(root: Path) -> None:
    around: dict[str, Any] = {"openings": [], "doors": [], "windows": []}
    corners = [[1, 1], [2, 1], [2, 2], [1, 2]]
    _change(root, {"layout_visible": {"vertices": corners, **around}})
    with pytest.raises(DataError, match=rf"expected a room around {ROOM}/pano_1"):
        _zind(root).setup()
    data = _zind(root, test_fraction=1, skip_broken=True)
    assert len(names_of(data, "test")) == 5


def _change(root: Path, change: dict[str, Any]) -> None:
    file = root / "000" / "zind_data.json"
    content = json.loads(file.read_text())
    content["merger"]["floor_01"]["complete_room_01"]["partial_room_01"]["pano_1"] |= change
    file.write_text(json.dumps(content))


# --- pairs ----------------------------------------------------------------------------------------


def test_panoramas_inside_one_room_are_paired(tmp_path: Path) -> None:
    pairs = ZindPairs(write_homes(tmp_path, ["000", "001"]))
    assert pairs.names == [
        f"{home}/floor_01/complete_room_{room}"
        for home in ("000", "001")
        for room in ("01/pano_1 – pano_2", "02/pano_3 – pano_5")
    ]
    files = {side.rgb for _, *both in pairs.pairs for side in both}
    assert len(files) == 8
    assert {path.parent.parent.name for path in files} == {"000", "001"}
    pair = pairs.read(1)
    assert pair.left.name.endswith("pano_3")
    assert pair.left.rgb.shape == (64, 128, 3)
    with pytest.raises(SettingError, match=r"erp_height: found 65; expected at most 64"):
        ZindPairs(tmp_path, erp_height=65).read(1)


def test_both_panoramas_see_the_same_room(tmp_path: Path) -> None:
    """Every point, of either panorama, is on the room as it is in the world, in meters."""
    room = replace(CORNERED, ceiling_z=0.8)
    cameras = [Camera("pano_1", (1.2, 0.7), 25), Camera("pano_2", (0.9, 4.5), -160)]
    write_home(tmp_path / "000", [(room, cameras)])
    pair = ZindPairs(tmp_path, erp_height=32).read(0)
    unit_m = SCALE * METERS
    corners = np.array(room.vertices) * unit_m
    for side, camera in zip((pair.left, pair.right), cameras, strict=True):
        assert side.pose is not None
        assert side.distance_m is not None
        np.testing.assert_allclose(
            side.pose.location_m, np.array([*camera.xy, 1]) * unit_m, atol=1e-12
        )
        labels = brute_force_labels(camera.layout(room), 0.8, (32, 64))
        known = ~np.isnan(side.distance_m)
        np.testing.assert_array_equal(known, (labels > 0) & (labels < 4), err_msg="not of doors")
        points_m = side.pose.points_m(equirect_directions((32, 64))[known], side.distance_m[known])
        level = np.abs(points_m[:, 2] - np.array([[0], [1.8 * unit_m]])).min(axis=0) < 1e-4
        walls = points_m[~level][:, :2]
        assert 0.2 < level.mean() < 0.9
        assert -1e-4 < points_m[:, 2].min() < points_m[:, 2].max() < 1.8 * unit_m + 1e-4
        on_a_line = [np.abs(walls[:, axis, None] - corners[:, axis]) for axis in (0, 1)]
        np.testing.assert_allclose(np.min(on_a_line, axis=(0, 2)), 0, atol=1e-4)
        # A corner of the room is seen where the layout has it.
        seen, away_m = side.pose.project([0, 6 * unit_m, unit_m])
        x, y = camera.local([(0, 6)])[0]
        np.testing.assert_allclose(seen * away_m, np.array([y, -x, 0]) * unit_m, atol=1e-9)
