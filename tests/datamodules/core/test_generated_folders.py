"""Generated data sets: mended where files are missing; other folders are left alone."""

from __future__ import annotations

import shutil
from collections import namedtuple
from dataclasses import replace
from pathlib import Path

import pytest

from datamodules import SynthRooms, SynthShapes
from datamodules.synthrooms.generate import generate_rooms
from datamodules.synthshapes import generate as shapes
from datamodules.synthshapes.generate import generate_shapes
from tangent_train.errors import DataError
from tangent_train.rendering import TangentRepresentation
from tests.datamodules.conftest import TINY_ROOMS, TINY_SHAPES
from tests.datamodules.data_files import contents, names_of

ROOM_FILES = ("area_5a/pano/*/*_depth.png", "area_1/data/*/*_pose.json", "semantic_labels.json")
SHAPE_FILES = ("vase/test/vase_0003.off", "cup/train/cup_0001.off")
_Generated = namedtuple("_Generated", "setting generate settings module some_files")
every_generator = pytest.mark.parametrize(
    "of",
    [
        _Generated("rooms", generate_rooms, TINY_ROOMS, SynthRooms, ROOM_FILES),
        _Generated("shapes", generate_shapes, TINY_SHAPES, SynthShapes, SHAPE_FILES),
    ],
    ids=lambda of: of.setting,
)


@every_generator
def test_missing_files_are_generated_again_and_others_kept(
    of: _Generated, tmp_path: Path, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shapes, "_PER_PROCESS", 1)
    original = request.getfixturevalue(f"tiny_{of.setting}")
    copy = shutil.copytree(original, tmp_path / "copy")
    for pattern in of.some_files:
        next(copy.glob(pattern)).unlink()
    of.generate(copy, of.settings, workers=2)
    assert contents(copy) == contents(original), "the same for any number of processes"
    before = {path: path.stat().st_mtime_ns for path in copy.rglob("*") if path.is_file()}
    of.generate(copy, of.settings)
    assert {path: path.stat().st_mtime_ns for path in before} == before


@every_generator
def test_folders_of_other_settings_and_of_others_are_left_alone(
    of: _Generated, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    root = request.getfixturevalue(f"tiny_{of.setting}")
    before = contents(root)
    with pytest.raises(DataError, match=r"found seed=3; expected seed=9\. Name another"):
        of.generate(root, replace(of.settings, seed=9))
    assert contents(root) == before
    (tmp_path / "area_1").mkdir()
    with pytest.raises(DataError, match=rf"not {of.module.__name__}' .*area_1"):
        of.generate(tmp_path, of.settings)
    assert not contents(tmp_path)


@every_generator
def test_data_are_generated_then_read_like_the_real_set(
    of: _Generated, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("os.cpu_count", lambda: 1)  # in this process
    settings = {of.setting: vars(of.settings), "val_fraction": 0.5}
    module = of.module(tmp_path / "data", TangentRepresentation(0, 2), **settings)
    with pytest.raises(DataError, match="no such folder"):
        module.setup()
    module.prepare_data()
    names = {split: names_of(module, split) for split in ("train", "val", "test")}
    assert all(names.values())
    assert all(("area_5" in name) or ("/test/" in name) for name in names["test"])
    batch = next(iter(module.test_dataloader()))
    images = module.on_after_batch_transfer(batch, 0).images
    assert images.shape[1:] == (20, module.in_channels, 4, 4)
    before = contents(tmp_path / "data")
    module.prepare_data()  # the spheres in the folder are not foreign files
    assert contents(tmp_path / "data") == before
