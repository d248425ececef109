from __future__ import annotations

import os
from collections import namedtuple
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from datamodules import Stanford2D3DS
from datamodules.core.store import Declared, Store
from tangent_train.manifest import Shard
from tangent_train.errors import DataError, SettingError
from tangent_train.rendering import EquirectRepresentation
from tests.conftest import fabricate
from tests.datamodules.data_files import contents

MakeModule = Callable[..., Stanford2D3DS]

PANORAMAS = 8


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """A data set of eight panoramas, one or two of every area."""
    rooms = {"1": ("office_1", "office_2")} | dict.fromkeys(
        ("2", "3", "4", "5a", "5b", "6"), ("office_1",)
    )
    return fabricate(tmp_path / "data", rooms, photos=1)


@pytest.fixture
def store(tmp_path: Path) -> Path:
    return tmp_path / "store"


@pytest.fixture
def make_module(root: Path, erp: Any, store: Path) -> MakeModule:
    def make(**settings: Any) -> Stanford2D3DS:
        return Stanford2D3DS(root, erp, **{"store": store, **settings})

    return make


def _times(folder: Path) -> dict[Path, int]:
    return {path: path.stat().st_mtime_ns for path in folder.rglob("*") if path.is_file()}


def _made(folder: Path, before: dict[Path, int]) -> set[Path]:
    return {path for path, time in _times(folder).items() if before.get(path) != time}


# --- one file ----------------------------------------------------------------------------------


NUMBERS = {"rgb": Declared("int64", ("n",))}


@pytest.fixture
def source(tmp_path: Path) -> Path:
    path = tmp_path / "image.png"
    path.write_bytes(b"abc")
    return path


def test_stored_arrays_are_memory_mapped(source: Path, store: Path) -> None:
    rng = np.random.default_rng(0)
    arrays = {
        "rgb": rng.integers(0, 256, (5, 7, 3), np.uint8),
        "depth": rng.integers(0, 2**16, (5, 7), np.uint16),
        "camera_matrix": rng.random((3, 3)),
    }
    layout = {
        "rgb": Declared("uint8", ("H", "W", 3)),
        "depth": Declared("uint16", (5, 7)),
        "camera_matrix": Declared("float64", (3, 3)),
    }
    Store(store, layout).make("room/küche 1", {"rgb": source}, lambda: arrays)
    found = Store(store, layout).read("room/küche 1", {"rgb": source})
    record = np.load(store / "room" / "küche 1.npy", allow_pickle=False)
    for name, array in arrays.items():
        assert found[name].dtype == array.dtype
        assert not found[name].flags.writeable
        assert not found[name].flags.owndata
        np.testing.assert_array_equal(found[name], array)
        np.testing.assert_array_equal(record[name], array, err_msg="NumPy reads it alone")


def _objects(path: Path) -> None:
    np.save(path, np.array([{}], object), allow_pickle=True)


def _flip(path: Path, place: int) -> None:
    content = bytearray(path.read_bytes())
    content[place] ^= 1
    path.write_bytes(content)


@pytest.mark.parametrize(
    "damage",
    [
        lambda path: path.unlink(),
        lambda path: path.write_bytes(path.read_bytes()[:-5]),
        lambda path: path.write_bytes(path.read_bytes().rpartition(b"\n")[0] + b"\n[]"),
        *(partial(_flip, place=place) for place in (0, 9, 30, 90, 128, 1000, 4000, 4130, -2)),
        lambda path: np.save(path, np.zeros(3)),
        _objects,
    ],
)
def test_damage_is_found_on_opening(
    source: Path, store: Path, damage: Callable[[Path], object]
) -> None:
    one = Store(store, NUMBERS)
    one.make("a", {"rgb": source}, lambda: {"rgb": np.arange(500)})
    assert Store(store, NUMBERS).is_current("a", {"rgb": source}, whole=True)
    damage(one.path("a"))
    assert not one.is_current("a", {"rgb": source}, whole=True)
    with pytest.raises(DataError, match=r"a\.npy: found .*Run tangent-prepare"):
        one.read("a", {"rgb": source})


@pytest.mark.parametrize(
    "change",
    [
        lambda arrays: arrays | {"rgb": arrays["rgb"].astype(np.int16)},
        lambda arrays: arrays | {"rgb": arrays["rgb"][:, ::2]},
        lambda arrays: {key: array[:-1] for key, array in arrays.items()},
        lambda arrays: arrays | {"labels": arrays["labels"][..., None]},
        lambda arrays: arrays | {"labels": arrays["labels"] + np.uint8(1)},
        lambda arrays: arrays | {"more": arrays["labels"]},
        lambda arrays: {"labels": arrays["labels"]},
        lambda arrays: {},
    ],
)
@pytest.mark.parametrize("side", [4, "H"])
def test_other_arrays_than_declared_are_refused(
    source: Path, store: Path, change: Any, side: int | str
) -> None:
    """A whole file, as of another level or other classes, in the place of this one."""
    layout = {"rgb": Declared("uint8", (side, 6, 3)), "labels": Declared("uint8", (side, 6), 5)}
    arrays = {"rgb": np.zeros((4, 6, 3), np.uint8), "labels": np.full((4, 6), 5, np.uint8)}
    files = {"rgb": source}
    Store(store, layout).make("a", files, lambda: arrays)
    assert Store(store, layout).is_current("a", files, whole=True)
    changed = change(arrays)
    Store(store, layout).make("a", files, lambda: changed)
    if side == "H" and {array.shape[:2] for array in changed.values()} == {(3, 6)}:
        assert Store(store, layout).is_current("a", files, whole=True)
        return
    message = r"a\.npy: found .*expected rgb: uint8 \([4H], 6, 3\), labels: .* up to 5.*Run"
    with pytest.raises(DataError, match=message):
        Store(store, layout).read("a", files)


@pytest.mark.parametrize(("size", "seconds"), [(3, -1), (4, 0)])
@pytest.mark.parametrize("is_late", [False, True])
def test_a_changed_source_is_noticed(
    source: Path, store: Path, size: int, seconds: int, is_late: bool
) -> None:
    """One that changes while it is read too: the arrays may be of the old file."""
    time = source.stat().st_mtime_ns

    def change() -> None:
        source.write_bytes(b"x" * size)
        os.utime(source, ns=(0, time + seconds * 10**9))  # also older, as by cp -p

    def read() -> dict[str, Any]:
        if is_late:
            change()
        return {"rgb": np.arange(5)}

    one = Store(store, NUMBERS)
    one.make("a", {"rgb": source}, read)
    change()
    with pytest.raises(DataError, match=r"found rgb made from image\.png \(3 bytes"):
        one.read("a", {"rgb": source})


# --- a data set --------------------------------------------------------------------------------


def _samples(module: Any) -> list[torch.Tensor]:
    training, testing = list(module.train_dataloader()), list(module.test_dataloader())
    tensors = [part for one in training for part in (*one.images, one.labels)]
    return tensors + [part for one in testing for part in (*one.images, one.target)]


@pytest.mark.parametrize(
    "settings",
    [{"inputs": ["rgb"]}, {"unknown": "any_black", "num_workers": 1}, {"in_memory": True},
     {"test_rotation": 30}],
    ids=str,
)  # fmt: skip
def test_samples_and_class_weights_are_those_without_a_store(
    make_module: MakeModule, settings: dict[str, Any]
) -> None:
    prepared, plain = make_module(**settings), make_module(store=None, **settings)
    prepared.prepare_data()
    samples = zip(_samples(prepared), _samples(plain), strict=True)
    assert all(torch.equal(a, b) for a, b in samples)
    assert torch.equal(prepared.class_weights("log"), plain.class_weights("log"))


def test_parts_make_the_whole_store(make_module: MakeModule, store: Path, tmp_path: Path) -> None:
    make_module().prepare_data()
    other = tmp_path / "in parts"
    parts = [Shard(number, 3).part for number in (1, 2, 3)]
    assert [make_module(store=other).prepare_part(part) for part in parts] == [3, 3, 2]
    assert contents(other) == contents(store)
    with pytest.raises(SettingError, match=r"data\.store: found none, with shard="):
        make_module(store=None).prepare_part(parts[0])


def test_existing_files_are_kept_and_missing_ones_are_made(
    make_module: MakeModule, store: Path, root: Path, erp: Any
) -> None:
    make_module().prepare_data()
    before = _times(store)
    assert len(before) == PANORAMAS
    make_module(fold=2, seed=1).prepare_data()  # other splits of the same panoramas
    assert _times(store) == before
    damaged, flipped = sorted(before)[3:5]
    for skip_broken in (False, True):
        damaged.write_bytes(damaged.read_bytes()[:-9])
        _flip(flipped, 2000)
        before = _times(store)
        make_module(skip_broken=skip_broken).prepare_data()
        assert _made(store, before) == {damaged, flipped}
    make_module(unknown="any_black").prepare_data()
    Stanford2D3DS(root, EquirectRepresentation(level=2), store=store).prepare_data()
    assert len(_times(store)) == 3 * PANORAMAS, "choices and sizes lie beside each other"
    table = root / "semantic_labels.json"
    table.write_text(table.read_text().replace("sofa", "clutter"))
    changed, plain = make_module(), make_module(store=None)
    changed.prepare_data()
    assert len(_times(store)) == 4 * PANORAMAS, "as do class tables"
    np.testing.assert_array_equal(
        changed.source("test").read(0).labels, plain.source("test").read(0).labels
    )


def test_with_depth_also_serves_without_but_not_the_other_way(
    make_module: MakeModule, root: Path, store: Path
) -> None:
    make_module(inputs=["rgb"]).prepare_data()
    both = make_module()
    with pytest.raises(DataError, match="depth made from nothing; expected camera_"):
        both.source("test").read(0)
    before = _times(store)
    both.prepare_data()
    assert len(_made(store, before)) == PANORAMAS
    before = _times(store)
    for path in root.glob("area_*/pano/depth/*.png"):
        path.unlink()
    rgb = make_module(inputs=["rgb"])
    rgb.prepare_data()
    assert _times(store) == before
    assert rgb.source("test").read(0).depth is None


def test_a_store_that_is_not_there_or_not_a_folder(make_module: MakeModule, store: Path) -> None:
    with pytest.raises(DataError, match=r"no such file.*Run tangent-prepare .*data\.store"):
        make_module().source("train").read(0)
    store.write_text("a file")
    with pytest.raises(DataError, match="store"):
        make_module().prepare_data()


def test_an_evaluation_prepares_the_test_split_only(
    make_module: MakeModule, monkeypatch: pytest.MonkeyPatch, store: Path
) -> None:
    State, Trainer = namedtuple("State", "fn"), namedtuple("Trainer", "state")
    module = make_module()
    monkeypatch.setattr(module, "trainer", Trainer(State("test")))
    module.prepare_data()
    assert {path.relative_to(store).parts[1] for path in _times(store)} == {"area_5a", "area_5b"}
