from __future__ import annotations

import csv
import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from tangent_train.metrics.segmentation import ConfusionMatrices
from tangent_train.results.segmentation import (
    evaluation_results,
    largest_loss,
    results_table,
    write_results,
)

NAMES = ("unknown", "wall", "floor", "sofa")


def _matrices() -> ConfusionMatrices:
    """Walls found by 90 %, floors by half, no sofa."""
    erp = np.zeros((4, 4), np.int64)
    erp[1, 1], erp[1, 2] = 90, 10
    erp[2, 2], erp[2, 1] = 50, 50
    bands = np.zeros((6, 4, 4), np.int64)
    bands[2] = erp
    return ConfusionMatrices(erp, erp / 10, bands, 7)


def test_results_are_plain_and_complete(tmp_path: Path) -> None:
    results = evaluation_results(_matrices(), NAMES, "skip")
    write_results(results, tmp_path)
    read = json.loads((tmp_path / "results.json").read_text())
    assert read == results
    assert read["images"] == 7
    assert read["macc"] == (0.9 + 0.5) / 2
    assert read["miou"] == (90 / 150 + 50 / 110) / 2
    assert [c["class"] for c in read["classes"]] == ["wall", "floor", "sofa"]
    assert read["classes"][2]["iou"] is None, "absent: not defined"
    assert read["latitude_bands"][2]["latitude_deg"] == [0, 30]
    assert read["latitude_bands"][2]["miou"] == read["miou"]
    assert read["latitude_bands"][0]["miou"] is None
    assert read["confusion"][1] == [0, 90, 10, 0]


def test_csv_and_markdown_hold_the_same_figures(tmp_path: Path) -> None:
    write_results(evaluation_results(_matrices(), NAMES, "zero"), tmp_path)
    with (tmp_path / "results.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["class"] for row in rows] == ["wall", "floor", "sofa"]
    assert float(rows[0]["iou"]) == 0.6
    assert float(rows[2]["iou"]) == 0.0
    text = (tmp_path / "results.md").read_text()
    assert "| wall | 60.0 | 90.0 | 60.0 | 90.0 | 50.0 |" in text
    assert "| 0° … 30° |" in text


def test_the_table_shows_every_class_and_the_mean() -> None:
    console = Console(width=120, record=True, file=io.StringIO())
    console.print(results_table(evaluation_results(_matrices(), NAMES, "skip")))
    text = console.export_text()
    for word in ("7 panoramas", "wall", "60.0", "sofa", "–", "mean", "52.7"):
        assert word in text


def test_photos_have_neither_solid_angles_nor_latitudes(tmp_path: Path) -> None:
    matrices = _matrices()._replace(
        solid_angle=np.zeros((4, 4)), bands=np.zeros((6, 4, 4), np.int64)
    )
    results = evaluation_results(matrices, NAMES, "zero", "photos")
    assert (results["miou_solid_angle"], results["classes"][0]["iou_solid_angle"]) == (None, None)
    assert results["latitude_bands"] == []
    write_results(results, tmp_path)
    text = (tmp_path / "results.md").read_text()
    assert text.startswith("# Results over 7 photos\n")
    assert "latitude" not in text
    assert "| wall | 60.0 | 90.0 | – | – | 50.0 |" in text


def _with(pixels: dict[tuple[int, int], int], absent: Any = "skip") -> dict[str, Any]:
    """Results of a matrix with these counts."""
    matrix = np.zeros((4, 4), np.int64)
    for place, count in pixels.items():
        matrix[place] = count
    return evaluation_results(_matrices()._replace(pixels=matrix), NAMES, absent)


@pytest.mark.parametrize(
    ("pixels", "sentence"),
    [
        (
            {(1, 1): 90, (1, 2): 10, (2, 2): 50, (2, 1): 30, (2, 3): 20},
            "Largest loss: floor, 45.5 % IoU; most often taken for wall (30.0 % of its pixels).",
        ),
        (
            {(2, 2): 3, (2, 0): 1},
            "Largest loss: floor, 75.0 % IoU; most often taken for unknown (25.0 % of its pixels).",
        ),
        (  # found whole, and much else with it; predictions where nothing is known do not count
            {(1, 1): 5, (2, 1): 10, (2, 2): 90, (3, 1): 5, (3, 3): 85, (0, 1): 999},
            "Largest loss: wall, 25.0 % IoU; all of it was found, but 50.0 % of what was taken for "
            "it is floor.",
        ),
        (  # both lost whole: the one with more pixels
            {(1, 3): 5, (2, 3): 9},
            "Largest loss: floor, 0.0 % IoU; most often taken for sofa (100.0 % of its pixels).",
        ),
        ({(1, 1): 5, (3, 3): 1}, "No loss: every labelled class has 100 % IoU."),
        ({(0, 1): 7, (0, 2): 2}, None),
        ({}, None),
    ],
)
def test_the_largest_loss_is_that_of_a_labelled_class(
    pixels: dict[tuple[int, int], int], sentence: str | None
) -> None:
    for absent in ("skip", "zero"):
        assert largest_loss(_with(pixels, absent)) == sentence


def test_the_largest_loss_is_said_wherever_the_table_is(tmp_path: Path) -> None:
    results = evaluation_results(_matrices(), NAMES, "zero")
    sentence = largest_loss(results)
    assert sentence is not None
    assert sentence.startswith("Largest loss: floor, 45.5 % IoU; most often taken for wall (50.0 %")
    console = Console(width=120, record=True, file=io.StringIO())
    console.print(results_table(results))
    assert " ".join(sentence.split()) in " ".join(console.export_text().split())
    write_results(results, tmp_path)
    assert f"\n\n{sentence}\n\n" in (tmp_path / "results.md").read_text()
    write_results(_with({}), tmp_path)
    assert "loss" not in (tmp_path / "results.md").read_text()


def test_names_with_brackets_are_shown_as_they_are() -> None:
    names = ("unknown", "wall [red]", "floor", "sofa")
    console = Console(width=160, record=True, file=io.StringIO())
    matrix = np.zeros((4, 4), np.int64)
    matrix[1, 2] = 1
    matrices = _matrices()._replace(pixels=matrix)
    console.print(results_table(evaluation_results(matrices, names, "skip")))
    assert "Largest loss: wall [red], 0.0 % IoU" in console.export_text()
