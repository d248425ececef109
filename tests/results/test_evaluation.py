"""Records, tables and files of an evaluation, from matrices counted by hand."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import nn

from tangent_train.metrics.segmentation import SegmentationCounts
from tangent_train.results.evaluation import (
    EvaluationResult,
    confusion_table,
    evaluation_result,
    headline,
    result_tables,
    write_results,
)
from tests.tasks.builders import segmentation_task
from tests.tasks.shapes import shape_task

NAMES = ("unknown", "wall", "floor", "=sofa")
SHAPES = ("bottle", "chair [old]", "mug", "plant")
NO_VIEWS: Any = None
SGD = partial(torch.optim.SGD, lr=1)
SHAPE_MATRIX = np.array([[4, 0, 0, 0], [0, 8, 0, 0], [3, 0, 1, 0], [0, 0, 0, 0]])


def _matrices(pixels: dict[tuple[int, int], int] | None = None) -> SegmentationCounts:
    """Walls found by 90 %, floors by half, no sofa."""
    erp = np.zeros((4, 4), np.int64)
    for place, count in (pixels or {(1, 1): 90, (1, 2): 10, (2, 2): 50, (2, 1): 50}).items():
        erp[place] = count
    bands = np.zeros((6, 4, 4), np.int64)
    bands[2] = erp
    sums = np.stack([erp[1:].sum(axis=1), erp[:, 1:].sum(axis=0), erp.diagonal()[1:]])
    of_one_image = np.stack([sums, sums / 10])[None], np.zeros((1, 5, 3, 3)), np.zeros((1, 6))
    return SegmentationCounts(erp, bands, *of_one_image)


def _record(
    counts: SegmentationCounts | None = None, absent: Any = "skip", noun: str = "panoramas"
) -> EvaluationResult:
    """The record of seven images."""
    task = segmentation_task(nn.Identity(), NO_VIEWS, NAMES, SGD, absent_class=absent)
    return evaluation_result(task.head, counts or _matrices(), noun, 7)


def _record_of_shapes() -> EvaluationResult:
    task = shape_task(nn.Identity(), SHAPES)
    return evaluation_result(task.head, SHAPE_MATRIX, "shapes", 16)


def test_the_json_file_is_plain_and_complete(tmp_path: Path) -> None:
    write_results(_record(), tmp_path)
    read = json.loads((tmp_path / "results.json").read_text())
    assert (read["images"], read["noun"]) == (7, "panoramas")
    assert read["columns"]["miou"] == {
        "text": "mIoU", "unit": "%", "of_class": "iou", "class_text": "IoU",
        "better": "higher", "is_main": True, "of_sphere": False,
    }  # fmt: skip
    assert read["scores"]["macc"] == read["scores"]["macc_solid_angle"] == (0.9 + 0.5) / 2
    assert read["scores"]["miou"] == (90 / 150 + 50 / 110) / 2
    assert [entry["class"] for entry in read["classes"]] == ["wall", "floor", "=sofa"]
    assert read["classes"][2]["iou"] is None, "absent: undefined"
    assert read["latitude_bands"][2] == {
        "latitude_deg": [0, 30],
        "miou": read["scores"]["miou"],
        "macc": read["scores"]["macc"],
    }
    assert read["latitude_bands"][0]["miou"] is None
    assert read["confusion"][1] == [0, 90, 10, 0]


def test_csv_and_markdown_hold_the_same_scores(tmp_path: Path) -> None:
    write_results(_record(absent="zero"), tmp_path)
    with (tmp_path / "results.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["class"] for row in rows] == ["wall", "floor", "'=sofa"], "no formula"
    assert [float(row["iou"]) for row in rows] == [0.6, 50 / 110, 0.0]
    text = (tmp_path / "results.md").read_text()
    assert "mIoU 35.2\u00a0%" in text
    assert "| wall | 60.0 | 90.0 | 60.0 | 90.0 | 50.0 |" in text
    assert "| mean | 35.2 | 46.7 | 35.2 | 46.7 |  |" in text
    assert "| 0° … 30° | 35.2 | 46.7 |" in text
    assert "| 30° … 60° | – | – |" in text, "without a labeled pixel"


def test_classes_of_no_pixel_are_left_out_of_the_table() -> None:
    """Neither labeled nor predicted, and without a score that counts in the mean."""
    predicted = _matrices({(1, 1): 90, (1, 3): 10, (2, 2): 50})
    shown = {
        "skip": _record(),
        "zero": _record(absent="zero"),
        "predicted": _record(predicted),
    }
    names = {name: [row[0] for row in result_tables(r)[0].rows] for name, r in shown.items()}
    whole = ["wall", "floor", "=sofa", "mean"]
    assert names == {"skip": ["wall", "floor", "mean"], "zero": whole, "predicted": whole}


def test_photos_have_neither_solid_angles_nor_latitudes() -> None:
    counts = _matrices()
    halves = np.concatenate([counts.of_images] * 2) / 2 * [[[[1]], [[0]]]]
    of_photos = SegmentationCounts(
        counts.pixels,
        np.zeros((6, 4, 4), np.int64),
        halves,
        counts.regions[:0],
        counts.seam[:0],
    )
    record = _record(of_photos, "zero", "photos")
    assert record.scores["miou_solid_angle"] is None
    assert not record.latitude_bands
    (table,) = result_tables(record)
    assert not [name for name in table.header if "solid angle" in name]
    assert set(record.intervals) == {"macc", "miou"}
    plain = replace(record, intervals={})
    assert headline(plain) == "mAcc 46.7\u00a0%, mIoU 35.2\u00a0% over 7 photos"


def test_means_over_fewer_classes_have_a_note() -> None:
    """100 % mIoU of labels with one class is not the mean over all classes."""
    few = _record(_matrices({(1, 1): 90}))
    assert headline(few).endswith(" over 7 panoramas, 1 of 3 classes")
    assert (
        result_tables(few)[0].note
        == "Means without classes that do not occur in the labels: floor, =sofa."
    )
    as_zero = _record(_matrices({(1, 1): 90}), "zero")
    assert headline(as_zero).endswith(" over 7 panoramas")
    assert result_tables(as_zero)[0].note == ""


def test_means_stand_with_their_intervals(tmp_path: Path) -> None:
    """Two images, of one class each: a draw has either, or both."""
    of_images = np.array(  # labeled, predicted and hits of walls, floors and sofas
        [
            [[[100, 0, 0], [90, 10, 0], [90, 0, 0]], [[10, 0, 0], [9, 1, 0], [9, 0, 0]]],
            [[[0, 100, 0], [50, 50, 0], [0, 50, 0]], [[0, 10, 0], [6, 4, 0], [0, 4, 0]]],
        ],
        np.float64,
    )
    parts = {"regions": np.zeros((2, 5, 3, 3)), "seam": np.zeros((2, 6))}
    record = _record(_matrices()._replace(of_images=of_images, **parts))
    expected = dict.fromkeys(("macc", "miou"), (0.5, 0.9))
    expected |= dict.fromkeys(("macc_solid_angle", "miou_solid_angle"), (0.4, 0.9))
    assert record.intervals == {name: pytest.approx(ends) for name, ends in expected.items()}
    text = "mAcc 70.0 [50.0, 90.0]\u00a0%, mIoU 52.7 [50.0, 90.0]\u00a0%, "
    assert headline(record).startswith(text)
    assert headline(record).endswith(
        " over 7 panoramas, 2 of 3 classes (in brackets: 95\u00a0% intervals)"
    )
    write_results(record, tmp_path)
    mean = "| mean | 52.7 [50.0, 90.0] | 70.0 [50.0, 90.0] | 46.3 [40.0, 90.0] | 65.0 [40.0, 90.0]"
    assert mean in (tmp_path / "results.md").read_text()
    read = json.loads((tmp_path / "results.json").read_text())["intervals"]
    assert {name: tuple(ends) for name, ends in read.items()} == record.intervals


def test_the_heat_map_has_shares_of_the_true_class() -> None:
    """The shares include pixels predicted as unknown."""
    matrices = _matrices({(1, 0): 10, (1, 1): 65, (1, 2): 25, (2, 2): 7})
    table = confusion_table(_record(matrices))
    assert table.shades == [[0.65, 0.25, 0], [0, 1, 0], [0, 0, 0]]
    assert table.rows == [("wall", "65", "25", ""), ("floor", "", "100", ""), ("=sofa", "", "", "")]
    shapes = confusion_table(_record_of_shapes())
    assert shapes.rows[2] == ("mug", "75", "", "25", "")
