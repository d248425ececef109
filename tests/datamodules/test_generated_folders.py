"""Generated data sets: continued where they stopped; folders of other settings are left alone."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from datamodules.synthrooms.datamodule import SynthRooms, generate_rooms
from datamodules.synthshapes import SynthShapes, generate_shapes
from tangent_train.errors import DataError, SettingError
from tangent_train.rendering import TangentRepresentation
from tests.datamodules.conftest import TINY_ROOMS, TINY_SHAPES
from tests.datamodules.data_files import contents, names_of


def test_an_interrupted_data_set_is_continued(tiny_rooms: Path, tmp_path: Path) -> None:
    copy = shutil.copytree(tiny_rooms, tmp_path / "copy")
    finished = (copy / "finished.jsonl").read_text().splitlines(keepends=True)
    (copy / "finished.jsonl").write_text("".join(finished[:-2]))
    shutil.rmtree(copy / "area_5a")
    shutil.rmtree(copy / "area_5b")
    generate_rooms(copy, TINY_ROOMS, workers=2)
    found, expected = contents(copy), contents(tiny_rooms)
    assert sorted(found.pop("finished.jsonl")) == sorted(expected.pop("finished.jsonl"))
    assert found == expected, "the same for any number of processes"


def test_folders_of_other_settings_are_left_alone(tiny_rooms: Path, tiny_shapes: Path) -> None:
    for root in (tiny_rooms, tiny_shapes):
        before = contents(root)
        with pytest.raises(SettingError, match=r"seed: found 9; expected 3"):
            generate_rooms(root, replace(TINY_ROOMS, seed=9)) if root is tiny_rooms else (
                generate_shapes(root, replace(TINY_SHAPES, seed=9))
            )
        assert contents(root) == before


@pytest.mark.parametrize("module", [SynthRooms, SynthShapes])
def test_data_are_generated_then_read_like_the_real_set(
    module: type[SynthRooms | SynthShapes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("os.cpu_count", lambda: 1)  # in this process
    settings = {"rooms": TINY_ROOMS} if module is SynthRooms else {"shapes": TINY_SHAPES}
    data = module(tmp_path / "data", TangentRepresentation(0, 2), val_fraction=0.5, **settings)
    with pytest.raises(DataError):
        data.setup()
    data.prepare_data()
    names = {split: names_of(data, split) for split in ("train", "val", "test")}
    assert all(names.values())
    assert all(("area_5" in name) or ("/test/" in name) for name in names["test"])
    batch = next(iter(data.test_dataloader()))
    images = data.on_after_batch_transfer(batch, 0).images
    assert images.shape[1:] == (20, data.in_channels, 4, 4)
    before = contents(tmp_path / "data")
    data.prepare_data()
    assert contents(tmp_path / "data") == before
