"""SynPASS: decoding, splits, weather, day and night."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from datamodules.core.files import SPLITS
from datamodules.synpass import SynPASS
from tangent_train.rendering import EquirectRepresentation
from tests.datamodules import street_format as streets
from tests.datamodules.data_files import names_of


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two panoramas of each point; not to be changed."""
    return streets.write_synpass(tmp_path_factory.mktemp("synpass"))


def panoramas(root: Path, **settings: Any) -> SynPASS:
    return SynPASS(root, EquirectRepresentation(4), **settings)


@pytest.mark.parametrize("index", [0, 1], ids=["gray", "palette"])
def test_every_number_has_its_class(shared: Path, index: int) -> None:
    stored = streets.numbers(streets.SYNPASS_NUMBERS, (32, 64), index)
    panorama = panoramas(shared).dataset("test").read(index)
    np.testing.assert_array_equal(panorama.labels, np.where(stored == 255, 0, stored))
    assert set(np.unique(stored)) == {*range(23), 255}
    error = np.abs(panorama.rgb.astype(int) - streets.colors(stored)[..., ::-1])
    assert error.mean() < 40, "JPEG of the same image"


def test_splits_are_those_of_the_folders(shared: Path) -> None:
    names = {split: names_of(panoramas(shared), split) for split in SPLITS}
    assert names["test"] == ["MAP_8_point1/sun/000000", "MAP_8_point1/sun/000001"]
    assert [len(names[split]) for split in SPLITS] == [6, 4, 2]
    data = panoramas(shared, test_split="val", val_fraction=0.4)
    points = {s: {name.split("/")[0] for name in names_of(data, s)} for s in SPLITS}
    assert points["test"] == {"MAP_6_point10", "MAP_6_point11"}
    assert not points["train"] & points["val"]
    assert [len(names_of(data, split)) for split in SPLITS] == [4, 2, 4]


def test_weather_and_time_are_settings_and_groups(shared: Path) -> None:
    data = panoramas(shared, test_split="val")
    groups = [data.groups(files) for files in data.splits()["test"]]
    assert groups == [["fog", "day"]] * 2 + [["sun", "night"]] * 2
    sun = panoramas(shared, weather=["sun"], test_split="val", val_fraction=0)
    assert {name.split("/")[1] for s in SPLITS for name in names_of(sun, s)} == {"sun"}
    night = names_of(panoramas(shared, time="night", test_split="val"), "test")
    assert {name.split("/")[0] for name in night} == {"MAP_6_point11"}
