"""Tables, their cache, and processes that fork."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch.utils.data import DataLoader, Dataset

from tangent_train.errors import SettingError
from tangent_train.geometry import TangentGrid, equirect_directions, random_rotation
from tangent_train.rendering import (
    equirect_to_tangent,
    set_table_cache_limit,
    tables,
    tangent_to_equirect,
    tangent_to_labels,
)
from tangent_train.rendering.threads import over_rows

FLOAT64 = np.dtype(np.float64)
TURN = random_rotation(np.random.default_rng(2))


@pytest.fixture
def cache(monkeypatch: pytest.MonkeyPatch) -> tables.TableCache:
    fresh = tables.TableCache(limit=2**24)
    monkeypatch.setattr(tables, "TABLES", fresh)
    return fresh


@pytest.mark.parametrize("base_level", range(5))
@pytest.mark.parametrize("rotation", [None, TURN])
@pytest.mark.parametrize("shape", [(64, 128), (63, 125)])
def test_owners_are_the_nearest_centres(
    base_level: int, rotation: NDArray[np.float64] | None, shape: tuple[int, int]
) -> None:
    grid = TangentGrid(base_level, base_level + 5, rotation=rotation)
    table = tables.owner_table(grid, shape, FLOAT64)
    directions = equirect_directions(shape)
    cosines = directions @ grid.centers_xyz.T
    owned = np.take_along_axis(cosines, table.face[0][..., None].astype(int), axis=-1)[..., 0]
    np.testing.assert_allclose(owned, cosines.max(axis=-1), rtol=0, atol=1e-12)
    places = grid.project(directions, table.face[0])
    np.testing.assert_allclose(np.stack([table.u[0], table.v[0]], axis=-1), places, atol=1e-9)


@pytest.mark.parametrize("grid", [TangentGrid(0, 5), TangentGrid(1, 6, dim=40, rotation=TURN)])
def test_feathering_knows_every_image_that_sees_a_pixel(grid: TangentGrid) -> None:
    shape = (40, 81)
    table = tables.feather_table(grid, shape, FLOAT64, slice(0, 40))
    assert table.weight is not None
    found = np.zeros((grid.num_images, *shape))
    np.put_along_axis(found, table.face[:1].astype(int), table.weight[:1], axis=0)
    for rank in range(1, len(table.face)):
        index = table.face[rank][None].astype(int)
        previous = np.take_along_axis(found, index, axis=0)
        np.put_along_axis(found, index, previous + table.weight[rank], axis=0)
    faces = np.arange(grid.num_images)[:, None, None]
    places = grid.project(equirect_directions(shape), np.broadcast_to(faces, found.shape))
    offset = np.abs(places - (grid.dim - 1) / 2) / (grid.dim / 2)
    seen = (offset < 1).all(axis=-1)
    raw = np.where(seen, ((1 - offset**2) ** tables.FEATHER_POWER).prod(axis=-1), 0)
    np.testing.assert_allclose(found, raw / raw.sum(axis=0), atol=1e-12)


@pytest.mark.parametrize("blend", ["feather", "nearest"])
def test_bands_are_parts_of_the_whole(monkeypatch: pytest.MonkeyPatch, blend: Any) -> None:
    grid, shape = TangentGrid(0, 5), (32, 64)
    images = torch.rand(20, 2, 32, 32, dtype=torch.float64)
    whole = tangent_to_equirect(images, grid, shape, blend)
    labels = tangent_to_labels(images, grid, shape, blend)
    monkeypatch.setattr("tangent_train.rendering.backward._BAND", 64 * 5)
    bands = tangent_to_equirect(images, grid, shape, blend)
    torch.testing.assert_close(bands, whole, atol=1e-14, rtol=0)
    torch.testing.assert_close(tangent_to_labels(images, grid, shape, blend), labels)


def test_tables_are_reused(cache: tables.TableCache) -> None:
    image = np.zeros((32, 64), np.uint8)
    equirect_to_tangent(image, TangentGrid(0, 4), [1, 2])
    assert len(cache) == 2
    dtype = np.dtype(np.float32)
    first = tables.forward_map(TangentGrid(0, 4), (32, 64), [1], dtype)
    assert tables.forward_map(TangentGrid(0, 4), (32, 64), [1], dtype) is first
    assert tables.forward_map(TangentGrid(0, 4), (16, 32), [1], dtype) is not first


def test_rotated_grids_are_not_kept(cache: tables.TableCache) -> None:
    equirect_to_tangent(np.zeros((32, 64)), TangentGrid(0, 4, rotation=TURN))
    tangent_to_equirect(torch.zeros(20, 1, 16, 16), TangentGrid(0, 4, rotation=TURN), (8, 16))
    assert len(cache) == 0


def test_the_cache_is_bounded_by_bytes() -> None:
    cache = tables.TableCache(limit=100)
    for key in "abc":
        cache.get(key, lambda: "value", lambda _: 40)
    assert (len(cache), cache.nbytes) == (2, 80)
    assert cache.get("b", lambda: "new", lambda _: 40) == "value"
    cache.get("d", lambda: "value", lambda _: 40)
    assert cache.get("b", lambda: "new", lambda _: 40) == "value"  # c was used longest ago
    assert cache.get("c", lambda: "new", lambda _: 40) == "new"
    cache.get("too large", lambda: "value", lambda _: 101)
    assert cache.nbytes == 80
    cache.set_limit(0)
    assert (len(cache), cache.nbytes) == (0, 0)


def test_the_limit_can_be_set(cache: tables.TableCache) -> None:
    set_table_cache_limit(50_000)
    equirect_to_tangent(np.zeros((32, 64), np.float32), TangentGrid(0, 4))
    assert 0 < cache.nbytes <= 50_000
    set_table_cache_limit(0)
    assert cache.nbytes == len(cache) == 0
    with pytest.raises(SettingError, match="cache limit"):
        set_table_cache_limit(-1)


def test_tables_of_another_device_are_copied_once(cache: tables.TableCache) -> None:
    grid = TangentGrid(0, 4)
    for _ in range(2):
        images = equirect_to_tangent(torch.zeros(3, 16, 32, device="meta"), grid, [0, 1])
        assert images.device.type == "meta"
        labels = tangent_to_labels(torch.zeros(20, 2, 16, 16, device="meta"), grid, (16, 32))
        assert (labels.device.type, labels.dtype) == ("meta", torch.int64)
        assert len(cache) == 6  # two maps and the owners, here and there
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("tangent_train.rendering.backward._BAND", 64)
        scores = torch.zeros(20, 1, 16, 16, device="meta")
        tangent_to_equirect(scores, grid, (16, 32), "feather")
    assert len(cache) == 7  # and which images are near; bands of feathering are not kept


def test_threads_may_render_at_the_same_time() -> None:
    grid, shape = TangentGrid(0, 5), (256, 512)
    scores = np.random.default_rng(0).random((20, 5, 32, 32), np.float32)
    expected = tangent_to_labels(scores, grid, shape)
    with ThreadPoolExecutor(4) as pool:
        runs = [pool.submit(tangent_to_labels, scores, grid, shape) for _ in range(8)]
    assert all(np.array_equal(run.result(), expected) for run in runs)


class _Rendered(Dataset[tuple[Any, Any]]):
    def __init__(self) -> None:
        rng = np.random.default_rng(0)
        self.grid, self.shape = TangentGrid(0, 6), (256, 512)
        self.scores = rng.random((20, 5, 64, 64), np.float32)
        self.image = rng.integers(0, 255, (*self.shape, 3), np.uint8)

    def __len__(self) -> int:
        return 1

    def __getitem__(self, index: int) -> tuple[Any, Any]:
        labels = tangent_to_labels(self.scores, self.grid, self.shape)
        return labels, equirect_to_tangent(self.image, self.grid)


@pytest.mark.filterwarnings("ignore:This process:DeprecationWarning")  # Python 3.12 warns of forks
def test_forked_workers_render_after_their_parent() -> None:
    rendered = _Rendered()
    expected = rendered[0]
    loader = DataLoader(
        rendered, batch_size=None, num_workers=1, multiprocessing_context="fork", timeout=60
    )
    with tables.TABLES._lock:  # as held by another thread of the parent when it forks
        found = next(iter(loader))
    for mine, theirs in zip(expected, found, strict=True):
        np.testing.assert_array_equal(mine, theirs)


def test_rows_are_covered_once_and_errors_surface() -> None:
    visited = np.zeros(1000, int)

    def visit(start: int, stop: int) -> None:
        visited[start:stop] += 1

    over_rows(visit, (1000, 1000))
    assert (visited == 1).all()

    def fail(start: int, stop: int) -> None:
        raise ValueError(start, stop)

    with pytest.raises(ValueError, match="0"):
        over_rows(fail, (1000, 1000))
