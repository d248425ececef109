"""The tables of ``docs/studies.md``: those that nothing random is in."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from tangent_train.tasks.reports.cells import Cells, line
from tangent_train.tasks.studies.angular_resolution import angular_resolution
from tangent_train.tasks.studies.fov import fov
from tangent_train.tasks.studies.outcome import Outcome
from tangent_train.tasks.studies.representation_distortion import representation_distortion
from tangent_train.tasks.studies.surface_area import surface_area

PAGE = (Path(__file__).resolve().parents[3] / "docs" / "studies.md").read_text()


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
