"""Tables, their cache, threads, and processes that fork."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch.utils.data import DataLoader

from tangent_train.geometry import TangentGrid, equirect_directions, random_rotation
from tangent_train.rendering import (
    equirect_to_tangent,
    tables,
    tangent_to_equirect,
    tangent_to_labels,
)

ROTATION = random_rotation(np.random.default_rng(2))


@pytest.mark.parametrize("base_level", [0, 1, 4])
@pytest.mark.parametrize(("rotation", "shape"), [(None, (64, 128)), (ROTATION, (63, 125))])
def test_owners_are_the_nearest_centers(
    base_level: int, rotation: NDArray[np.float64] | None, shape: tuple[int, int]
) -> None:
    grid = TangentGrid(base_level, base_level + 3, rotation=rotation)
    numbers = np.broadcast_to(np.arange(grid.num_images)[:, None, None], (grid.num_images, 8, 8))
    owner = tangent_to_equirect(numbers, grid, shape, interpolation="nearest")
    cosines = equirect_directions(shape) @ grid.centers_xyz.T
    owned = np.take_along_axis(cosines, owner[..., None], axis=-1)[..., 0]
    np.testing.assert_allclose(owned, cosines.max(axis=-1), rtol=0, atol=1e-12)
    np.testing.assert_array_equal(tables.owners(grid, shape), owner)


@pytest.mark.parametrize("at_pole", [None, 0, 7])
def test_spans_contain_the_covered_pixels_and_few_others(at_pole: int | None) -> None:
    shape, grid = (130, 200), TangentGrid(1, 6)
    if at_pole is not None:
        grid = grid.with_rotation([[1], [-1], [1]] * grid.world_from_camera[at_pole].T)
    geometry = tables.canvas_geometry(grid, grid.face_indices(), shape, None)
    first, count = np.moveaxis(geometry.spans[..., None], 2, 0)
    held = (np.arange(shape[1]) - first) % shape[1] < count
    x, y, z = np.einsum("nji,hwj->inhw", grid.world_from_camera, equirect_directions(shape))
    half = grid.dim / 2 * grid.pitch
    seen = (z > 0) & (np.maximum(np.abs(x), np.abs(y)) < half * z)
    assert not np.any(seen & ~held)
    assert held.sum() < 1.1 * seen.sum()


@pytest.mark.parametrize("rotation", [None, ROTATION])
def test_tables_are_computed_once(
    monkeypatch: pytest.MonkeyPatch, rotation: NDArray[np.float64] | None
) -> None:
    """The paper's released code computes its tables again for each panorama."""

    def render(shape: tuple[int, int]) -> list[NDArray[np.generic]]:
        grid = TangentGrid(0, 4, 15, rotation)  # a new, equal grid every time
        panorama = np.random.default_rng(0).random((*shape, 3), np.float32)
        images = torch.from_numpy(equirect_to_tangent(panorama, grid)).permute(0, 3, 1, 2)
        both = [tangent_to_equirect(images, grid, shape, blend) for blend in ("nearest", "feather")]
        labels = tangent_to_labels(images, grid, shape)
        return [result.numpy() for result in (images, labels, *both)]

    def computed_again(*_: object) -> None:
        pytest.fail("a table was computed again")

    first = render((40, 80))
    for maker in ("over_rows", "positions_of_rays"):
        monkeypatch.setattr(tables, maker, computed_again)
    for result, before in zip(render((40, 80)), first, strict=True):
        np.testing.assert_array_equal(result, before)
    with pytest.raises(pytest.fail.Exception, match="computed again"):
        render((40, 82))


def test_the_cache_is_bounded_by_bytes() -> None:
    cache = tables.TableCache(limit=100)

    def get(key: str, size: int = 40) -> int:
        return cache.get(key, lambda: (np.full(size, len(made), np.uint8),))[0][0]

    made: list[str] = ["a", "b", "c"]
    for key in made:
        get(key)
    assert cache.nbytes == 80
    made.append("d")
    assert get("b") == 3
    get("d")
    made.append("e")
    assert get("b") == 3, "c was used longest ago"
    assert get("c") == 5
    get("too large", 101)
    assert cache.nbytes == 80


@pytest.mark.filterwarnings("ignore:This process:DeprecationWarning")  # Python 3.12 warns of forks
def test_forked_workers_render_after_their_parent() -> None:
    rng, grid, shape = np.random.default_rng(0), TangentGrid(0, 6), (256, 512)
    scores = rng.random((20, 5, 64, 64), np.float32)
    image = rng.integers(0, 255, (*shape, 3), np.uint8)

    def render(_: int) -> tuple[Any, Any]:
        return tangent_to_labels(scores, grid, shape), equirect_to_tangent(image, grid)

    expected, forked = render(0), {"num_workers": 1, "multiprocessing_context": "fork"}
    loader: Any = DataLoader([0], batch_size=None, collate_fn=render, timeout=60, **forked)  # type: ignore[arg-type]
    for in_parent, in_worker in zip(expected, next(iter(loader)), strict=True):
        np.testing.assert_array_equal(in_parent, in_worker)
