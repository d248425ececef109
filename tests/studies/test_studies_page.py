"""The tables of ``docs/studies.md``: those that nothing random is in."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from studies.angular_resolution import angular_resolution
from studies.fov import fov
from studies.outcome import Outcome
from studies.representation_distortion import representation_distortion
from studies.surface_area import surface_area
from tangent_train.results.reports.cells import Cells, line

PAGE = (Path(__file__).resolve().parents[2] / "docs" / "studies.md").read_text()


def on_one_line(cells: Cells) -> Cells:
    return tuple(cell.replace("\n", " ") for cell in cells)


@pytest.mark.parametrize("study", [surface_area, angular_resolution, fov])
def test_levels_are_as_computed(study: Callable[[int], Outcome]) -> None:
    for cells in study(10).cells():
        assert line(on_one_line(cells)) in PAGE


def test_distortion_is_as_computed() -> None:
    """But for what pixels tell, which depends on how many there are."""
    header, *rows = (on_one_line(cells) for cells in representation_distortion(16).cells())
    start = PAGE.index(line(header))
    shown = [text.split(" | ") for text in PAGE[start:].splitlines()[2 : 2 + len(rows)]]
    closed = [k for k, name in enumerate(header) if name != "pixels"]
    for cells, texts in zip(rows, shown, strict=True):
        assert [texts[k].strip("| ") for k in closed] == [cells[k] for k in closed]
