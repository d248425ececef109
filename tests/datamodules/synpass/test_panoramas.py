"""SynPASS: decoding, pairs, splits, weather, day and night."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from datamodules import SynPASS
from datamodules.core.splits import SPLITS
from tangent_train.errors import DataError
from tangent_train.rendering import EquirectRepresentation
from tests.datamodules.cityscapes import street_format as streets
from tests.datamodules.data_files import names_of, write_png


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two panoramas of each point; not to be changed."""
    return streets.write_synpass(tmp_path_factory.mktemp("synpass"))


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return streets.write_synpass(tmp_path)


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
    assert not names_of(panoramas(shared, val_fraction=0), "val")


def test_a_test_on_val_takes_whole_training_points_for_validation(shared: Path) -> None:
    data = panoramas(shared, test_split="val", val_fraction=0.4)
    points = {s: {name.split("/")[0] for name in names_of(data, s)} for s in SPLITS}
    assert points["test"] == {"MAP_6_point10", "MAP_6_point11"}
    assert not points["train"] & points["val"]
    assert [len(names_of(data, split)) for split in SPLITS] == [4, 2, 4]


def test_weather_and_time_are_settings_and_groups(shared: Path) -> None:
    data = panoramas(shared, test_split="val")
    files = data.index().splits["test"]
    assert [data.groups(f) for f in files] == [["fog", "day"]] * 2 + [["sun", "night"]] * 2
    sun = panoramas(shared, weather=["sun"], test_split="val", val_fraction=0)
    assert {name.split("/")[1] for s in SPLITS for name in names_of(sun, s)} == {"sun"}
    night = names_of(panoramas(shared, time="night", test_split="val"), "test")
    assert {name.split("/")[0] for name in night} == {"MAP_6_point11"}


def test_a_check_names_what_lists_and_files_disagree_on(root: Path) -> None:
    missing = root / "semantic/cloud/train/MAP_1_point1/000000_trainID.png"
    missing.unlink()
    stray = root / "semantic/fog/val/MAP_6_point10/000007_trainID.png"
    write_png(stray, np.ones((32, 64), np.uint8))
    problems, count = panoramas(root).check()
    assert count == 12
    assert [problem.file for problem in problems.listed()] == [str(missing)]
    assert sorted(problems.warnings) == [
        "all_map_night_val.txt: 1 without an image, e.g. MAP_7_point99",
        "found 6 train, 4 val, 2 test; published are 5700 train, 1690 val, 1690 test or "
        "5700 train, 2180 val, 1200 test",
        f"label images: 1 without an image, e.g. {stray}",
    ]


@pytest.mark.parametrize(
    ("settings", "listed"), [({"val_fraction": 0}, 1), ({"weather": "fog"}, 0)]
)
def test_points_outside_the_chosen_splits_and_weathers_are_not_missing(
    shared: Path, settings: dict[str, Any], listed: int
) -> None:
    warnings = panoramas(shared, **settings).check()[0].warnings
    assert [text for text in warnings if text.startswith("all_map")] == [
        "all_map_night_val.txt: 1 without an image, e.g. MAP_7_point99"
    ] * listed


def test_lists_that_cannot_be_used_are_refused(root: Path) -> None:
    with pytest.raises(DataError, match=r"all_map_day_val\.txt: found no point of test"):
        panoramas(root, time="day").setup()
    (root / "all_map_day_val.txt").write_text("")
    with pytest.raises(DataError, match="found no point of val"):
        panoramas(root, time="day", test_split="val").setup()
    (root / "all_map_day_val.txt").unlink()
    with pytest.raises(DataError, match="No such file"):
        panoramas(root, time="day", test_split="val").setup()
    assert len(names_of(panoramas(root), "train")) == 6


def test_other_numbers_and_an_empty_folder_are_refused(root: Path) -> None:
    path = root / "semantic/cloud/train/MAP_1_point1/000000_trainID.png"
    write_png(path, np.full((32, 64), 23, np.uint8))
    (problem,) = panoramas(root).check()[0].listed()
    assert "found numbers 23; expected 0, 1" in str(problem.error)
    with pytest.raises(DataError, match=r"img: found no panoramas.*Trans4PASS"):
        panoramas(root / "img").setup()
