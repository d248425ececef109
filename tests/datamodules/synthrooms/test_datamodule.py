from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest

from datamodules import SynthRooms
from datamodules.core.found import Split
from tangent_train.errors import DataError, SettingError

if TYPE_CHECKING:
    from pathlib import Path

ROOMS: dict[str, Any] = {"rooms": {"1": 2, "3": 0, "5a": 1}, "height": 16, "supersample": 1}


def test_rooms_are_generated_then_read_like_the_real_set(
    tmp_path: Path, strips: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("os.cpu_count", lambda: 1)  # in this process
    module = SynthRooms(tmp_path / "rooms", strips, rooms=ROOMS, validation_fraction=0.5)
    with pytest.raises(DataError, match="no such folder"):
        module.setup()
    module.prepare_data()
    module.setup("fit")
    splits: tuple[Split, ...] = ("train", "val", "test")
    names = [module.sample_name(s, i) for s in splits for i in range(len(module.source(s)))]
    assert {name.partition("/")[0] for name in names} == {"area_1", "area_5a"}
    assert len(list(module.train_dataloader())) == 1
    (sample,) = module.test_dataloader()
    assert [image.shape for image in sample.images] == [(1, 4, 16, 8, 3), (1, 4, 16, 8)]
    assert sample.target.max() > 0
    assert module.sample_name("test", 0).startswith("area_5a/")


def test_a_fold_without_test_rooms(tmp_path: Path, strips: Any) -> None:
    with pytest.raises(SettingError, match="fold 2: 2, 4"):
        SynthRooms(tmp_path, strips, rooms=ROOMS, fold=2)
