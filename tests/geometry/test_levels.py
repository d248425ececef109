"""Levels of panoramas, and the tables of ``docs/levels.md``."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from tangent_train.errors import SettingError
from tangent_train.geometry import TangentGrid, equirect_shape, nearest_level

PAGE = Path(__file__).resolve().parents[2] / "docs" / "levels.md"


@pytest.mark.parametrize("level", [0, 1, 7, 13])
def test_the_level_s_own_rows(level: int) -> None:
    rows, _ = equirect_shape(level)
    assert nearest_level(rows) == level
    assert nearest_level(math.floor(rows * math.sqrt(2))) == level
    assert nearest_level(math.ceil(rows * math.sqrt(2))) == level + 1


def test_too_few_rows() -> None:
    with pytest.raises(SettingError, match="1 rows"):
        nearest_level(1)


def _tables() -> list[list[list[str]]]:
    tables: list[list[list[str]]] = [[]]
    for line in PAGE.read_text().splitlines():
        if line.startswith("|"):
            tables[-1].append([cell.strip() for cell in line.strip("|").split("|")])
        elif tables[-1]:
            tables.append([])
    return [[table[0], *table[2:]] for table in tables if table]


def _grid(base_level: int, level: int) -> TangentGrid | None:
    try:
        return TangentGrid(base_level, level)
    except SettingError:
        return None


def test_the_page_s_tables() -> None:
    panoramas, images, sides, pixels = _tables()
    assert len(panoramas) == 9
    for level, size, degrees in panoramas[1:]:
        height, width = equirect_shape(int(level))
        assert size == f"{height} × {width}"
        assert degrees == f"{360 / width:.4f}"
    assert len(images) == 6
    for base_level, number, across, corners in images[1:]:
        grid = TangentGrid(int(base_level), 10)
        assert number == str(grid.num_images)
        assert across == f"{2 * math.degrees(math.atan(grid.dim * grid.pitch / 2)):.2f}°"
        assert corners == f"{grid.fov_deg:.2f}°"
    for table in (sides, pixels):
        assert len(table) == 6
        for base_level, *cells in table[1:]:
            for level, cell in zip(table[0][1:], cells, strict=True):
                grid_there = _grid(int(base_level), int(level))
                if grid_there is None:
                    assert cell == "–"
                elif table is sides:
                    least = TangentGrid.least_dim(grid_there.base_level, grid_there.level)
                    assert cell == f"{grid_there.dim} ({least})"
                else:
                    assert cell == f"{math.degrees(grid_there.pitch):.4f}"
