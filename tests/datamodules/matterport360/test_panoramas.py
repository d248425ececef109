from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

from datamodules import Matterport360
from datamodules.core.splits import SPLITS
from datamodules.matterport360.panoramas import CLASSES, read_table
from tangent_train.errors import DataError
from tests.datamodules.data_files import names_of, write_png
from tests.datamodules.matterport360.matterport_format import SCENES, write_matterport

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
    reading: Any = replace(cast("Any", data.index().read), shape=None)
    row: list[int] = reading.labels(data.dataset("test").items[0])[-1].tolist()
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
        panorama, reading = data.dataset("test").read(k), cast("Any", data.index().read)
        assert (panorama.rgb[-1] == 90).all()
        steps = reading.reader.depth(data.dataset("test").items[k])[0]
        assert steps[:42].tolist() == [round(n * 1500 * 512 / 4000) for n in range(42)]
        labels, without = data.dataset("test").labels(k), masked.dataset("test").labels(k)
        assert not without[0].any()
        np.testing.assert_array_equal(without[-1], labels[-1])
        assert labels[0].any()


@pytest.mark.parametrize(("release", "counts"), [("360fv", (61, 7, 18)), ("sfss", (66, 12, 12))])
def test_scenes_are_those_of_the_published_lists(release: str, counts: tuple[int, ...]) -> None:
    splits = [row[release] for row in read_table("scenes.csv")]
    assert tuple(splits.count(split) for split in SPLITS) == counts
    scenes = [row["scene"] for row in read_table("scenes.csv")]
    assert len(set(scenes)) == len(scenes) == 90
    on_both = [r for r in read_table("scenes.csv") if (r["360fv"], r["sfss"]) == ("test", "train")]
    assert len(on_both) == 10


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


# Lists and files that disagree.


def test_missing_scenes_and_counts_are_reported(root: Path, erp: Any) -> None:
    problems, count = Matterport360(root, erp).check()
    *missing, counts = problems.warnings
    assert (
        missing[0] == "59 of 61 scenes of train are missing, such as 1LXtFkjw3qL, "
        "1pXnuDYAj8r, 29hnd4uzFmX"
    )
    assert [text[:28] for text in missing[1:]] == [
        "6 of 7 scenes of val are mis",
        "16 of 18 scenes of test are ",
    ]
    assert counts == "found 4 train, 2 val, 4 test; published are 7829 train, 772 val, 2014 test"
    assert (count, problems.listed()) == (10, [])


def test_lists_of_the_release_are_compared(tmp_path: Path, erp: Any) -> None:
    root = write_matterport(tmp_path)
    name = f"{SCENES[4]} 0{SCENES[4]}\n"
    (root / "train.txt").write_text("")
    (root / "validation.txt").write_text(name + name.replace(" 0", " 1") + name)
    (root / "test.txt").write_text(f"{SCENES[3]} 0{SCENES[3]}\n{SCENES[3]} nothing\n")
    problems, _ = Matterport360(root, erp, release="sfss").check()
    lists = problems.warnings[3:]
    rest, unlisted = "without a panorama in a scene of", "of these scenes are not in it"
    assert [
        text.removeprefix(f"{root}/").removesuffix(". Scenes define the splits.") for text in lists
    ] == [
        f"train.txt: 0 names, 0 of them repeated, 0 {rest} train; 6 panoramas {unlisted}",
        f"validation.txt: 3 names, 1 of them repeated, 0 {rest} val; 0 panoramas {unlisted}",
        f"test.txt: 2 names, 0 of them repeated, 1 {rest} test; 1 panoramas {unlisted}",
    ]


def test_other_files_are_refused(erp: Any, tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"no panoramas of release=360fv; expected <scene>/rgb"):
        Matterport360(tmp_path, erp).setup()
    root = write_matterport(tmp_path, SCENES[:3])
    write_png(root / SCENES[2] / f"semantic/0{SCENES[2]}.png", np.full((32, 64), 42, np.uint8))
    write_png(root / SCENES[0] / f"depth/1{SCENES[0]}.png", np.full((32, 64), 42, np.uint8))
    problems, _ = Matterport360(root, erp, inputs=["rgb", "depth"]).check()
    depth, labels = [problem.finding for problem in problems.listed()]
    assert "8-bit gray; expected 16-bit gray" in depth
    assert labels.startswith("numbers 42; expected 0, 1")
