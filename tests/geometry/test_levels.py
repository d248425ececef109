"""Levels of panoramas, and the tables of ``docs/levels.md``."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from tangent_train.errors import SettingError
from tangent_train.geometry import TangentGrid, equirect_shape, nearest_level

PAGE = (Path(__file__).parents[2] / "docs" / "levels.md").read_text().splitlines()


@pytest.mark.parametrize("level", [0, 1, 7, 13])
def test_the_level_s_own_rows(level: int) -> None:
    rows, _ = equirect_shape(level)
    assert nearest_level(rows) == level
    assert nearest_level(math.floor(rows * math.sqrt(2))) == level
    assert nearest_level(math.ceil(rows * math.sqrt(2))) == level + 1


def test_too_few_rows() -> None:
    with pytest.raises(SettingError, match="1 rows"):
        nearest_level(1)


def _row(*cells: object) -> str:
    return f"| {' | '.join(map(str, cells))} |"


@pytest.mark.parametrize("level", range(5, 13))
def test_the_page_s_panoramas(level: int) -> None:
    height, width = equirect_shape(level)
    assert _row(level, f"{height} × {width}", f"{360 / width:.4f}") in PAGE


@pytest.mark.parametrize("base_level", range(5))
def test_the_page_s_images(base_level: int) -> None:
    """The angles between corners are the paper's."""
    grid = TangentGrid(base_level, 10)
    across = math.degrees(2 * math.atan(grid.dim * grid.pitch / 2))
    assert _row(base_level, grid.num_images, f"{across:.2f}°", f"{grid.fov_deg:.2f}°") in PAGE
    levels = range(max(5, base_level + 2), 13)
    missing = ["–"] * (8 - len(levels))
    grids = [TangentGrid(base_level, level) for level in levels]
    sides = [f"{one.dim} ({TangentGrid.least_dim(base_level, one.level)})" for one in grids]
    assert _row(base_level, *missing, *sides) in PAGE
    pitches = [f"{math.degrees(one.pitch):.4f}" for one in grids]
    assert _row(base_level, *missing, *pitches) in PAGE
