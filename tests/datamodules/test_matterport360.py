"""Panoramas of Matterport3D in both releases: classes, depth, splits, reports."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from datamodules.core.files import SPLITS
from datamodules.matterport360 import CLASSES, Matterport360
from datamodules.tables import read_table
from tangent_train.errors import DataError
from tests.datamodules.data_files import names_of
from tests.datamodules.matterport_format import SCENES, write_matterport

TWENTY = [
    *(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 8, 7, 8, 12, 13, 14, 15, 3, 8, 16, 8, 17, 8, 18, 19),
    *(8, 8, 8, 8, 20, 9, 7, 7, 8, 7, 8, 8, 8, 8, 0),
]
"""Class of each number, as PanoSAMic has it."""


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_matterport(tmp_path_factory.mktemp("matterport"))


def _labels(data: Matterport360) -> list[int]:
    """Label of each number."""
    row: list[int] = data.decode(data.splits()["test"][0]).labels[-1].tolist()
    assert row[:22] == row[42:]
    return row[:42]


def test_every_number_has_its_class(root: Path, erp: Any) -> None:
    data = Matterport360(root, erp)
    assert data.class_names == ("unknown", *CLASSES)
    assert len(CLASSES) == 20
    assert _labels(data) == TWENTY
    published = _labels(Matterport360(root, erp, classes="360bev"))
    differing = {n: CLASSES[published[n] - 1] for n in range(42) if published[n] != TWENTY[n]}
    assert differing == {24: "picture", 36: "objects", 41: "objects"}
    sfss = Matterport360(root, erp, release="sfss")
    assert _labels(sfss) == list(range(42))
    assert len(sfss.class_names) == 42
    assert sfss.class_names[1:4] + sfss.class_names[-1:] == ("void", "wall", "floor", "misc")


@pytest.mark.parametrize("release", ["360fv", "sfss"])
def test_colors_depth_and_black_pixels(root: Path, erp: Any, release: Any) -> None:
    given: Any = {"release": release, "inputs": ["rgb", "depth"]}
    data = Matterport360(root, erp, **given)
    masked = Matterport360(root, erp, **given, unknown="all_black")
    for k in range(2):
        image = data.decode(data.splits()["test"][k])
        assert (image.rgb[-1] == 90).all()
        assert image.depth is not None
        steps = image.depth[0]
        assert steps[:42].tolist() == [round(n * 1500 * 512 / 4000) for n in range(42)]
        labels, without = (d.dataset("test").read(k).labels for d in (data, masked))
        assert labels[0].any()
        assert not without[0].any()
        np.testing.assert_array_equal(without[-1], labels[-1])


@pytest.mark.parametrize(("release", "counts"), [("360fv", (61, 7, 18)), ("sfss", (66, 12, 12))])
def test_scenes_are_those_of_the_published_lists(release: str, counts: tuple[int, ...]) -> None:
    rows = read_table("matterport360_scenes")
    assert tuple([row[release] for row in rows].count(split) for split in SPLITS) == counts
    assert len({row["scene"] for row in rows}) == len(rows) == 90
    assert [(row["360fv"], row["sfss"]) for row in rows].count(("test", "train")) == 10


def test_a_split_has_all_panoramas_of_its_scenes(root: Path, erp: Any) -> None:
    data = Matterport360(root, erp)
    found = {split: sorted({n[:11] for n in names_of(data, split)}) for split in SPLITS}
    assert found == {"train": [SCENES[0], SCENES[3]], "val": [SCENES[1]],
                     "test": [SCENES[2], SCENES[4]]}  # fmt: skip
    assert names_of(data, "val") == [f"{SCENES[1]}/{k}{SCENES[1]}" for k in range(2)]
    other = Matterport360(root, erp, release="sfss", test_split="val")
    assert {n[:11] for n in names_of(other, "test")} == {SCENES[4]}
    train, val = ({n[:11] for n in names_of(other, split)} for split in ("train", "val"))
    assert train | val == set(SCENES[:3])
    assert len(val) == 1


def test_missing_scenes_and_counts_are_reported(root: Path, erp: Any, tmp_path: Path) -> None:
    problems, count = Matterport360(root, erp).check()
    *missing, counts = problems.warnings
    assert missing[0].startswith("59 of 61 scenes of train are missing, such as 1LXtFkjw3qL")
    assert counts == "found 4 train, 2 val, 4 test; published are 7829 train, 772 val, 2014 test"
    assert (count, problems.listed()) == (10, [])
    with pytest.raises(DataError, match=r"found no panoramas; .*Request Matterport3D"):
        Matterport360(tmp_path, erp).setup()
