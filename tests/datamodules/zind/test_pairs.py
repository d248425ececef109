"""Pairs of ZInD: who is paired, and whether poses and distances agree in one world."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

from datamodules import ZindPairs
from tangent_train.errors import DataError
from tangent_train.geometry import equirect_directions
from tests.datamodules.zind.zind_format import (
    CORNERED,
    METERS,
    SCALE,
    Camera,
    Room,
    write_home,
    write_homes,
)


def test_panoramas_inside_one_room_are_paired(tmp_path: Path) -> None:
    pairs = ZindPairs(write_homes(tmp_path, ["000", "001"]))
    assert pairs.names == [
        f"{home}/floor_01/complete_room_{room}"
        for home in ("000", "001")
        for room in ("01/pano_1 – pano_2", "02/pano_3 – pano_5")
    ]
    assert len(pairs.files) == 8
    assert {path.parent.parent.name for path in pairs.files} == {"000", "001"}
    pair = pairs.read(1)
    assert pair.left.name.endswith("pano_3")
    assert pair.right.file.name.endswith("pano_5.jpg")
    assert pair.left.rgb.shape == (64, 128, 3)


def test_both_panoramas_see_the_same_room(tmp_path: Path) -> None:
    """Every point, of either panorama, is on the room as it is in the world, in metres."""
    room = Room(CORNERED.vertices, {}, ceiling_z=0.8)
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
        points_m = side.pose.points_m(equirect_directions((32, 64)), side.distance_m)
        level = np.abs(points_m[..., 2] - np.array([[[0]], [[1.8 * unit_m]]])).min(axis=0) < 1e-4
        walls = points_m[~level][:, :2]
        assert 0.2 < level.mean() < 0.9
        inside = (points_m[..., 2] > -1e-4) & (points_m[..., 2] < 1.8 * unit_m + 1e-4)
        assert inside.all()
        on_a_line = [np.abs(walls[:, axis, None] - corners[:, axis]) for axis in (0, 1)]
        np.testing.assert_allclose(np.min(on_a_line, axis=(0, 2)), 0, atol=1e-4)
        # A corner of the room is seen where the layout says.
        seen, away_m = side.pose.seen([0, 6 * unit_m, unit_m])
        x, y = camera.local([(0, 6)])[0]
        np.testing.assert_allclose(seen * away_m, np.array([y, -x, 0]) * unit_m, atol=1e-9)


def test_distant_pairs_and_floors_of_unknown_size_are_left_out(tmp_path: Path) -> None:
    root = write_homes(tmp_path)
    near = math.hypot(1.9, 1.2) * SCALE * METERS
    assert len(ZindPairs(root, near + 1e-6).names) == 1
    with pytest.raises(DataError, match=r"found no two panoramas .*data\.max_distance_m=null"):
        _ = ZindPairs(root, near - 1e-6).names
    file = root / "000" / "zind_data.json"
    content = json.loads(file.read_text())
    content["scale_meters_per_coordinate"]["floor_01"] = None
    file.write_text(json.dumps(content))
    with pytest.raises(DataError, match=r"found no two panoramas .*scale_meters_per_coordinate"):
        _ = ZindPairs(root).names
