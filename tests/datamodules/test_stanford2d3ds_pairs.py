"""The paper's pairs, found among abbreviated names; pairs of rooms; poses."""

from __future__ import annotations

import json
import re
import shutil
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from datamodules.stanford2d3ds.pairs import StanfordPairs, published_pairs
from datamodules.stanford2d3ds.panoramas import read_panorama_pose
from datamodules.synthrooms.datamodule import RoomSettings, SynthRoomsPairs, generate_rooms
from tangent_train.errors import DataError, SettingError
from tangent_train.geometry import equirect_directions
from tests.datamodules.stanford_pairs_format import write_panorama, write_paper_pairs

ROOMS = RoomSettings(rooms={"1": 3}, least_cameras=2, height=64, supersample=1)


@pytest.fixture(scope="module")
def rooms(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("pairs") / "rooms"
    generate_rooms(root, ROOMS, workers=0)
    return root


@pytest.fixture(scope="module")
def area(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Small panoramas with the names of the paper's pairs, and some more of the same rooms."""
    return write_paper_pairs(tmp_path_factory.mktemp("stanford"))


# The table is the paper's.


def test_the_table_is_the_papers() -> None:
    pairs = published_pairs()
    assert [pair.number for pair in pairs] == list(range(60))
    assert Counter(pair.split for pair in pairs) == {"easy": 30, "hard": 30}
    for pair in pairs:
        assert pair.left != pair.right
        assert pair.left.partition("_")[2] == pair.right.partition("_")[2]
    assert len({frozenset((pair.left, pair.right)) for pair in pairs}) == 60
    assert pairs[25][1:5] == ("easy", "ee20957_hallway_6", "eaba8c8_hallway_6", 1.0)
    assert pairs[59].scores["L2"] == (0.29, 0.16, 0.54)
    assert pairs[1].scores["ERP"] == (0.27, 0.07, 0.27)


# Files are found by the beginnings of their names.


def test_all_pairs_are_found(area: Path) -> None:
    pairs = StanfordPairs(area)
    assert list(pairs.published) == pairs.names == [str(k) for k in range(60)]
    assert len({side.rgb for _, *both in pairs.pairs for side in both}) == 87
    pair = pairs.read(24)
    assert (pair.name, pair.split) == ("24", "easy")
    assert re.fullmatch(r"area_1/hallway_6/ee20957[0-9a-f]{25}", pair.left.name)
    assert re.fullmatch(r"area_1/hallway_6/bed890d[0-9a-f]{25}", pair.right.name)
    assert pair.left.rgb[0, 0].tolist() == [int("ee20957", 16) % 200] * 3
    assert pair.left.distance_m is not None
    assert np.isnan(pair.left.distance_m[0]).all()
    assert (pair.left.distance_m[1:] == 2).all()


def test_missing_names_are_listed_together(area: Path, tmp_path: Path) -> None:
    root = tmp_path / "copy"
    shutil.copytree(area, root)
    for name in ("f85a909", "33e598f"):
        next((root / "area_1/pano/rgb").glob(f"camera_{name}*")).unlink()
    # The same beginning in another room is another panorama.
    write_panorama(root, "5a18aa0" + "a" * 25, "office_99", 0)
    message = "found no panorama 33e598f_office_15, f85a909_office_3; "
    with pytest.raises(DataError, match=re.escape(message)):
        _ = StanfordPairs(root).names


def test_missing_areas_are_named(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"area_1.*Get Stanford2D3DS"):
        _ = StanfordPairs(tmp_path).names
    with pytest.raises(SettingError, match=r"no two panoramas of one room"):
        _ = StanfordPairs(tmp_path, selection="rooms").names


# Depth and pose agree: what one panorama sees is where the other sees it.


def _disagreement(left: Any, right: Any) -> float:
    """Median of |distance − its prediction from the left| / distance, where the right sees it."""
    known = np.isfinite(left.distance_m)
    points = left.pose.points_m(equirect_directions((64, 128))[known], left.distance_m[known])
    seen, predicted = right.pose.project(points)
    rows = ((0.5 - np.arcsin(seen[:, 2].clip(-1, 1)) / np.pi) * 64).astype(int).clip(0, 63)
    columns = ((np.arctan2(seen[:, 1], seen[:, 0]) / (2 * np.pi) + 0.5) * 128).astype(int) % 128
    found = right.distance_m[rows, columns]
    return float(np.nanmedian(np.abs(found - predicted) / found))


def test_pairs_of_synthetic_rooms_agree_in_depth_and_pose(rooms: Path) -> None:
    pairs = SynthRoomsPairs(rooms, rooms=ROOMS)
    assert len(set(pairs.names)) == len(pairs.names) >= 3
    assert not pairs.published
    for index in range(len(pairs.names)):
        pair = pairs.read(index)
        assert pair.left.name.rpartition("/")[0] == pair.right.name.rpartition("/")[0]
        assert pair.left.name != pair.right.name
        assert _disagreement(pair.left, pair.right) < 0.04
        assert _disagreement(pair.left._replace(pose=pair.right.pose), pair.right) > 0.1
        # The documented formula: c + d Rᵀ (s_y, −s_z, s_x).
        path = str(pairs.pairs[index][1].rgb).replace("rgb", "pose").replace(".png", ".json")
        record = json.loads(Path(path).read_text())
        rotation, s = np.array(record["camera_rt_matrix"])[:, :3], (0.6, -0.48, 0.64)
        expected = np.array(record["camera_location"]) + 2.5 * rotation.T @ [s[1], -s[2], s[0]]
        assert pair.left.pose is not None
        np.testing.assert_allclose(pair.left.pose.points_m(s, 2.5), expected, atol=1e-9)


def test_angles_in_degrees_and_a_fourth_row_are_understood(tmp_path: Path) -> None:
    path = Path(str(write_panorama(tmp_path, "a" * 32, "office_1", 120)).replace("rgb", "pose"))
    path = path.with_suffix(".json")
    before = read_panorama_pose(path)
    record = json.loads(path.read_text())
    record["camera_original_rotation"] = np.degrees(record["camera_original_rotation"]).tolist()
    record["camera_rt_matrix"].append([0, 0, 0, 1])
    path.write_text(json.dumps(record))
    after = read_panorama_pose(path)
    np.testing.assert_allclose(after.world_from_panorama, before.world_from_panorama, atol=1e-9)
