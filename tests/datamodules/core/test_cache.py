"""The cache of a data set: equal samples, current files, memory-mapped arrays."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from datamodules.core.cache import Cache
from datamodules.core.files import ImageFiles
from datamodules.stanford2d3ds.panoramas import Stanford2D3DS
from tests.conftest import fabricate


class _Item(NamedTuple):
    rgb: NDArray[np.uint8]
    depth: NDArray[np.uint16] | None = None
    matrix: NDArray[np.float64] | None = None


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """A data set of eight panoramas, one or two of every area."""
    rooms = {"1": ("office_1", "office_2")} | dict.fromkeys(
        ("2", "3", "4", "5a", "5b", "6"), ("office_1",)
    )
    return fabricate(tmp_path / "data", rooms)


def test_cached_arrays_are_memory_mapped(tmp_path: Path) -> None:
    source = tmp_path / "a.png"
    source.write_bytes(b"abc")
    files = ImageFiles("room/küche 1", source)
    item = _Item(np.arange(105, dtype=np.uint8).reshape(5, 7, 3), None, np.eye(3))
    cache = Cache(tmp_path / "cache", {"level": 5}, _Item)
    for _ in range(2):
        found = cache.read(files, lambda: item)
        assert found.depth is None
        for name in ("rgb", "matrix"):
            array = getattr(found, name)
            assert not array.flags.writeable
            assert not array.flags.owndata
            np.testing.assert_array_equal(array, getattr(item, name))
    record = np.load(cache.path(files), allow_pickle=False)
    np.testing.assert_array_equal(record["rgb"], item.rgb, err_msg="NumPy reads it alone")
    assert Cache(tmp_path / "cache", {"level": 6}, _Item).path(files) != cache.path(files)


@pytest.mark.parametrize(("size", "seconds"), [(3, -1), (4, 0)])
@pytest.mark.parametrize("is_late", [False, True])
def test_a_changed_source_is_read_again(
    tmp_path: Path, size: int, seconds: int, is_late: bool
) -> None:
    """One that changes while it is read too: the arrays may be of the old file."""
    source = tmp_path / "a.png"
    source.write_bytes(b"abc")
    time = source.stat().st_mtime_ns
    cache, files = Cache(tmp_path / "cache", {}, _Item), ImageFiles("a", source)

    def change() -> None:
        source.write_bytes(b"x" * size)
        os.utime(source, ns=(0, time + seconds * 10**9))  # also older, as by cp -p

    def decode(value: int) -> _Item:
        if is_late and value == 1:
            change()
        return _Item(np.full(5, value, np.uint8))

    cache.read(files, lambda: decode(1))
    change()
    assert cache.read(files, lambda: decode(2)).rgb.tolist() == [2] * 5
    assert cache.read(files, lambda: decode(3)).rgb.tolist() == [2] * 5


def _samples(module: Any) -> list[torch.Tensor]:
    training, testing = list(module.train_dataloader()), list(module.test_dataloader())
    tensors = [part for one in training for part in (*one.images, one.labels)]
    return tensors + [part for one in testing for part in (*one.images, one.labels)]


@pytest.mark.parametrize(
    "settings",
    [{"inputs": ["rgb"]}, {"unknown": "any_black", "num_workers": 1}, {"in_memory": True},
     {"test_rotation": 30}],
    ids=str,
)  # fmt: skip
def test_samples_and_class_weights_are_those_without_a_cache(
    root: Path, erp: Any, tmp_path: Path, settings: dict[str, Any]
) -> None:
    cached = Stanford2D3DS(root, erp, cache=tmp_path / "cache", **settings)
    plain = Stanford2D3DS(root, erp, **settings)
    cached.prepare_data()
    assert len(list((tmp_path / "cache").rglob("*.npy"))) == 8
    samples = zip(_samples(cached), _samples(plain), strict=True)
    assert all(torch.equal(a, b) for a, b in samples)
    assert torch.equal(cached.class_weights("log"), plain.class_weights("log"))


def test_only_missing_files_are_decoded(
    root: Path, erp: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cache = tmp_path / "cache"
    Stanford2D3DS(root, erp, cache=cache).prepare_data()
    sorted(cache.rglob("*.npy"))[0].unlink()
    decoded: list[str] = []
    read = Stanford2D3DS.read

    def noted(data: Any, files: Any) -> Any:
        decoded.append(files.name)
        return read(data, files)

    monkeypatch.setattr(Stanford2D3DS, "read", noted)
    Stanford2D3DS(root, erp, cache=cache).prepare_data()
    assert len(decoded) == 1
