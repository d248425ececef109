from __future__ import annotations

import json
import os
import re
import shutil
import zlib
from collections import namedtuple
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pytest
import torch

from datamodules.core.panoramas import Panorama
from datamodules.core.store_files import PAGE, open_stored, write_stored
from datamodules.stanford2d3ds.panoramas import AREAS, Stanford2D3DS
from tangent_train.errors import DataError

if TYPE_CHECKING:
    from collections.abc import Callable

    from tests.conftest import FabricateStanford

    MakeModule = Callable[..., Stanford2D3DS]

HEIGHT = 16
PANORAMAS = 8


@pytest.fixture
def root(fabricate_stanford: FabricateStanford, tmp_path: Path) -> Path:
    """A data set of eight panoramas, one or two of every area."""
    rooms = {"1": ("office_1", "office_2")} | dict.fromkeys(AREAS[1:], ("office_1",))
    return fabricate_stanford(tmp_path / "data", rooms)


@pytest.fixture
def store(tmp_path: Path) -> Path:
    return tmp_path / "store"


@pytest.fixture
def make_module(root: Path, strips: Any, store: Path) -> MakeModule:
    def make(**settings: Any) -> Stanford2D3DS:
        return Stanford2D3DS(root, strips, **{"store": store, **settings})

    return make


def _files(folder: Path) -> list[Path]:
    return sorted(path for path in folder.rglob("*") if path.is_file())


def _times(folder: Path) -> dict[Path, int]:
    return {path: path.stat().st_mtime_ns for path in _files(folder)}


def _made(folder: Path, before: dict[Path, int]) -> set[Path]:
    return {path for path, time in _times(folder).items() if before.get(path) != time}


def _panorama(*, depth: bool = True) -> Panorama:
    rng = np.random.default_rng(0)
    return Panorama(
        rng.integers(0, 256, (HEIGHT, 2 * HEIGHT, 3), np.uint8),
        rng.integers(0, 2**16, (HEIGHT, 2 * HEIGHT), np.uint16) if depth else None,
        rng.integers(0, 14, (HEIGHT, 2 * HEIGHT), np.uint8),
    )


# --- one file ----------------------------------------------------------------------------------


@pytest.mark.parametrize("depth", [True, False])
def test_what_is_written_is_read(tmp_path: Path, depth: bool) -> None:
    panorama, made_from = _panorama(depth=depth), {"files": {"rgb": "a.png (3 bytes)"}}
    write_stored(tmp_path / "a", panorama, made_from)
    stored = open_stored(tmp_path / "a")
    stored.check_content()
    for found, wanted in zip(stored.panorama, panorama, strict=True):
        if wanted is None:
            assert found is None
            continue
        assert found is not None
        assert found.dtype == wanted.dtype
        assert not found.flags.writeable
        np.testing.assert_array_equal(found, wanted)
    values, counts = np.unique(panorama.labels, return_counts=True)
    np.testing.assert_array_equal(stored.label_counts[values], counts)
    assert stored.label_counts.sum() == panorama.labels.size
    assert stored.made_from == made_from


def test_the_file_is_what_its_description_says(tmp_path: Path) -> None:
    # Read without the module: struct by hand, arrays where the JSON says.
    panorama = _panorama()
    write_stored(tmp_path / "a", panorama, {})
    content = (tmp_path / "a").read_bytes()
    version, length, checksum = np.frombuffer(content, "<u4", 3, offset=8).tolist()
    text = content[20 : 20 + length]
    assert (content[:8], version, zlib.crc32(text)) == (b"PANORAMA", 1, checksum)
    header = json.loads(text)
    start = -(-(20 + length) // PAGE) * PAGE
    assert zlib.crc32(content[start:]) == header["crc32"]
    assert len(content) == start + header["bytes"]
    for name, place in header["arrays"].items():
        assert place["offset"] % PAGE == 0
        array = np.frombuffer(content[start + place["offset"] :], place["dtype"])
        wanted = getattr(panorama, name)
        np.testing.assert_array_equal(array[: wanted.size], wanted.ravel())


def test_arrays_are_views_of_the_file(tmp_path: Path) -> None:
    write_stored(tmp_path / "a", _panorama(), {})
    stored = open_stored(tmp_path / "a")
    for array in stored.panorama[:3]:
        assert array is not None
        assert np.shares_memory(array, stored.content)


def _cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-PAGE])


def _append(path: Path) -> None:
    path.write_bytes(path.read_bytes() + bytes(1))


def _flip(place: int) -> Callable[[Path], None]:
    def flip(path: Path) -> None:
        content = bytearray(path.read_bytes())
        content[place] ^= 1
        path.write_bytes(content)

    return flip


DAMAGES: dict[str, tuple[Callable[[Path], object], str]] = {
    "missing": (Path.unlink, "found no such file"),
    "empty": (lambda path: path.write_bytes(b""), "found nothing to read"),
    "beginning only": (lambda path: path.write_bytes(b"PANORAMA"), "found another kind of file"),
    "header cut": (lambda path: path.write_bytes(path.read_bytes()[:100]), "found a corrupted or"),
    "other kind": (_flip(0), "found another kind of file"),
    "other version": (_flip(8), r"found version 0; expected version 1"),
    "header changed": (_flip(60), "found a corrupted or truncated header"),
    "cut off": (_cut, r"found \d+ bytes \(truncated\); expected \d+ bytes"),
    "longer": (_append, r"found \d+ bytes .*; expected \d+ bytes"),
    "content changed": (_flip(-2 * PAGE), "found corrupted content"),
    "last byte changed": (_flip(-1), "found corrupted content"),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_damage_is_found_on_opening_and_repaired(
    make_module: MakeModule, damage: str, store: Path
) -> None:
    inflict, message = DAMAGES[damage]
    module = make_module()
    module.prepare_data()
    path = store / "16x32_labels" / f"{module.sample_name('test', 1)}.panorama"
    before, whole = _times(store), path.read_bytes()
    inflict(path)
    source = module.source("test")
    source.read(0)  # the others can be read
    with pytest.raises(DataError, match=rf"{re.escape(str(path))}: {message}.*tangent-prepare"):
        source.read(1)
    again = make_module()
    again.prepare_store(whole=("train", "val", "test"))
    assert path.read_bytes() == whole
    assert _made(store, before) == {path}
    again.source("test").read(1)


# --- a data set --------------------------------------------------------------------------------


def _samples(module: Stanford2D3DS) -> list[torch.Tensor]:
    training, testing = list(module.train_dataloader()), list(module.test_dataloader())
    tensors = [part for one in training for part in (*one.images, one.labels)]
    return tensors + [part for one in testing for part in (*one.images, one.target)]


@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"inputs": ["rgb"]},
        {"mask": "any_black"},
        {"in_memory": True},
        {"num_workers": 1},
        {"test_rotation": 30},
    ],
    ids=str,
)
def test_samples_and_class_weights_are_those_without_a_store(
    make_module: MakeModule, settings: dict[str, Any]
) -> None:
    prepared, plain = make_module(**settings), make_module(store=None, **settings)
    prepared.prepare_data()
    assert prepared.source("test") is not plain.source("test")
    samples = zip(_samples(prepared), _samples(plain), strict=True)
    assert all(torch.equal(a, b) for a, b in samples)
    assert torch.equal(prepared.class_weights("log"), plain.class_weights("log"))


def test_samples_need_no_decoding(make_module: MakeModule, monkeypatch: pytest.MonkeyPatch) -> None:
    make_module().prepare_data()
    for name in ("read_color_png", "read_depth_png"):
        monkeypatch.setattr(f"datamodules.stanford2d3ds.panoramas.{name}", None)
    module = make_module()
    module.prepare_data()
    assert len(_samples(module)) > 0
    module.class_weights("log")


def test_nothing_is_made_twice(make_module: MakeModule, store: Path) -> None:
    module = make_module()
    module.prepare_data()
    before = _times(store)
    assert len(before) == PANORAMAS
    make_module().prepare_store(whole=("train", "val", "test"))
    make_module(fold=2, seed=1).prepare_data()  # other splits of the same panoramas
    assert _times(store) == before


def test_sizes_and_masks_lie_beside_each_other(
    make_module: MakeModule, strips: Any, store: Path
) -> None:
    make_module().prepare_data()
    make_module(mask="any_black").prepare_data()
    assert {path.name for path in store.iterdir()} == {"16x32_labels", "16x32_any_black"}
    assert len(_files(store)) == 2 * PANORAMAS


def test_with_depth_also_serves_without_but_not_the_other_way(
    make_module: MakeModule, root: Path, store: Path
) -> None:
    rgb, both = make_module(inputs=["rgb"]), make_module()
    rgb.prepare_data()
    with pytest.raises(DataError, match="made from depth nothing; expected depth camera_"):
        both.source("test").read(0)
    before = _times(store)
    both.prepare_data()
    assert len(_made(store, before)) == PANORAMAS
    before = _times(store)
    for path in root.glob("area_*/pano/depth/*.png"):
        path.unlink()
    make_module(inputs=["rgb"]).prepare_data()
    assert _times(store) == before
    assert make_module(inputs=["rgb"]).source("test").read(0).depth is None


@pytest.mark.parametrize("domain", ["rgb", "depth", "semantic"])
@pytest.mark.parametrize("change", ["time", "content"])
def test_changed_files_are_noticed(
    make_module: MakeModule, root: Path, domain: str, change: str, store: Path
) -> None:
    make_module().prepare_data()
    path = next((root / "area_6" / "pano" / domain).iterdir())
    if change == "time":
        os.utime(path, ns=(0, path.stat().st_mtime_ns + 1))
    else:
        image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        assert image is not None
        image[4:, :] //= 2
        time = path.stat().st_mtime_ns
        assert cv2.imwrite(str(path), image)
        os.utime(path, ns=(0, time))
    module = make_module(validation_fraction=0)
    place = [module.sample_name("train", i)[:6] for i in range(6)].index("area_6")
    part = "labels" if domain == "semantic" else domain
    with pytest.raises(DataError, match=rf"area_6/.*: found made from {part} camera_.* ns\); "):
        module.source("train").read(place)
    before = _times(store)
    module.prepare_data()
    (made,) = _made(store, before)
    assert "area_6" in made.parts
    module.source("train").read(place)


def test_another_class_table_is_noticed(make_module: MakeModule, root: Path, store: Path) -> None:
    make_module().prepare_data()
    table = root / "semantic_labels.json"
    os.utime(table)  # the same table, copied again, changes nothing
    make_module().source("test").read(0)
    table.write_text(table.read_text().replace("sofa", "clutter"))
    with pytest.raises(DataError, match="found made from class table"):
        make_module().source("test").read(0)
    before = _times(store)
    make_module().prepare_data()
    assert len(_made(store, before)) == PANORAMAS


def test_a_store_that_is_made_anew_for_others_is_not_read_on(
    make_module: MakeModule, root: Path
) -> None:
    module = make_module()
    module.prepare_data()
    source = module.source("test")
    source.read(0)
    table = root / "semantic_labels.json"
    table.write_text(table.read_text().replace("sofa", "clutter"))
    make_module().prepare_data()
    with pytest.raises(DataError, match="found made from class table"):
        source.read(0)


def test_damage_in_what_is_read_late_is_mended_before_training(
    make_module: MakeModule, store: Path
) -> None:
    module = make_module()
    module.prepare_data()
    path = store / "16x32_labels" / f"{module.sample_name('test', 1)}.panorama"
    whole = path.read_bytes()
    _flip(-1)(path)
    make_module().prepare_data()
    assert path.read_bytes() == whole


def test_a_store_that_cannot_be_a_folder(make_module: MakeModule, store: Path) -> None:
    store.write_text("a file")
    with pytest.raises(DataError, match=r"found a file; expected a folder for data\.store"):
        make_module().prepare_data()


def test_a_store_that_is_not_there(make_module: MakeModule) -> None:
    with pytest.raises(DataError, match=r"no such file.*Run tangent-prepare .*data\.store"):
        make_module().source("train").read(0)


def test_an_evaluation_prepares_the_test_split_only(
    make_module: MakeModule, monkeypatch: pytest.MonkeyPatch, store: Path
) -> None:
    State, Trainer = namedtuple("State", "fn"), namedtuple("Trainer", "state")
    module = make_module()
    monkeypatch.setattr(module, "trainer", Trainer(State("test")))
    module.prepare_data()
    assert {path.relative_to(store).parts[1] for path in _files(store)} == {
        "area_5a",
        "area_5b",
    }
    monkeypatch.setattr(module, "trainer", Trainer(State("fit")))
    module.prepare_data()
    assert len(_files(store)) == PANORAMAS


def test_an_interrupt_leaves_whole_files_and_work_goes_on(
    make_module: MakeModule, monkeypatch: pytest.MonkeyPatch, store: Path
) -> None:
    module = make_module()
    write = write_stored
    written: list[Path] = []

    def interrupted(path: Path, *content: Any) -> None:
        if len(written) == 3:
            raise KeyboardInterrupt
        written.append(path)
        write(path, *content)

    monkeypatch.setattr("os.cpu_count", lambda: 1)
    with monkeypatch.context() as patch:
        patch.setattr("datamodules.core.store.write_stored", interrupted)
        with pytest.raises(KeyboardInterrupt):
            module.prepare_data()
    before = _times(store)
    assert set(before) == set(written)
    module.prepare_store(whole=("train", "val", "test"))
    assert len(_made(store, before)) == PANORAMAS - 3
    assert len(_files(store)) == PANORAMAS


def test_a_full_disk_is_found_before_anything_is_written(
    make_module: MakeModule, monkeypatch: pytest.MonkeyPatch, store: Path
) -> None:
    make_module().prepare_data()
    needed = sum(path.stat().st_size for path in _files(store))
    shutil.rmtree(store)
    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr("shutil.disk_usage", lambda _: usage(needed, 1, needed - 1))
    with pytest.raises(DataError, match=r"data\.store: found 0\.0 GB free in .*for 8 panoramas"):
        make_module().prepare_data()
    assert not store.exists()
    monkeypatch.setattr("shutil.disk_usage", lambda _: usage(needed, 0, needed))
    make_module().prepare_data()
    assert len(_files(store)) == PANORAMAS


def test_progress_is_shown(make_module: MakeModule, capsys: pytest.CaptureFixture[str]) -> None:
    make_module().prepare_data()
    assert f"{PANORAMAS}/{PANORAMAS}" in capsys.readouterr().out
    make_module().prepare_data()
    again = capsys.readouterr().out
    assert "Checking the store" in again
    assert "Preparing" not in again
