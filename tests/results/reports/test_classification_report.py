"""Runs of classification in reports: what tables, files and the chart say of them."""

from __future__ import annotations

import csv
import io
import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from omegaconf import OmegaConf
from rich.console import Console

from datamodules.modelnet40.shape_files import MODELNET40
from tangent_train.errors import DataError
from tangent_train.results.classification import (
    classification_results,
    write_classification_results,
)
from tangent_train.results.reports.chart import report_png
from tangent_train.results.reports.groups import Group, group_runs
from tangent_train.results.reports.paper import SHAPE_DATA
from tangent_train.results.reports.runs import find_runs, load_run
from tangent_train.results.reports.tables import (
    notes,
    report_csv,
    report_json,
    report_markdown,
    report_tables,
)

NAMES = ("bottle", "chair", "mug")


def _write(
    folder: Path,
    bottles: int,
    seed: int = 0,
    train: str = "yaw",
    test: str | None = "yaw",
    data: str = "datamodules.SynthShapes",
    names: tuple[str, ...] = NAMES,
) -> Path:
    """Of 10 bottles so many are right, of 10 chairs all, of 20 mugs half; none of other classes."""
    matrix = np.zeros((len(names), len(names)), np.int64)
    matrix[:3, :3] = [[bottles, 0, 10 - bottles], [0, 10, 0], [10, 0, 10]]
    write_classification_results(classification_results(matrix, names), folder)
    settings = {
        "name": "shapes/default",
        "seed": seed,
        "level": 5,
        "data": {"_target_": data, "test_rotation": test, "seed": seed},
        "representation": {
            "_target_": "tangent_train.rendering.TangentRepresentation",
            "base_level": 0,
            "rotation": train,
        },
    }
    OmegaConf.save(OmegaConf.create(settings), folder / "config.yaml")
    return folder


def _groups(*folders: Path) -> list[Group]:
    return group_runs([load_run(folder) for folder in find_runs(folders)])


@pytest.fixture
def three_ways(tmp_path: Path) -> Path:
    """z / z with three seeds, z / SO3 and SO3 / SO3."""
    runs = tmp_path / "runs"
    for seed, bottles in enumerate((4, 6, 8)):
        _write(runs / f"z_z_{seed}", bottles, seed)
    _write(runs / "z_so3", 0, test="so3")
    _write(runs / "so3_so3", 5, train="so3", test="so3")
    return runs


def test_seeds_are_averaged_and_rotations_told_apart(three_ways: Path) -> None:
    groups = _groups(three_ways)
    assert sorted(len(group.runs) for group in groups) == [1, 1, 3]
    whole = max(groups, key=lambda group: len(group.runs))
    accuracy, of_classes = whole.figure("accuracy"), whole.figure("class_accuracy")
    assert accuracy.mean == pytest.approx((24 + 26 + 28) / 3 / 40)
    assert accuracy.over_seeds == pytest.approx(0.05)
    assert of_classes.mean == pytest.approx((0.6 + 1 + 0.5) / 3)
    assert whole.figure("accuracy", 0).over_seeds == pytest.approx(0.2)
    text = report_markdown(groups, [])
    (section,) = [line for line in text.splitlines() if line.startswith("## ")]
    assert section == "## SynthShapes"
    rows = [line for line in text.splitlines() if line.startswith("| 5 | shapes/default")]
    cells = {row.split(" | ")[2]: row.split(" | ")[3:] for row in rows}
    assert cells["z / z"] == ["0", "65.0 (± 5.0)", "70.0 (± 6.7)", "40", "3 |"]
    assert cells["z / SO3"][1] == "50.0"
    assert cells["SO3 / SO3"][1] == "62.5"
    assert "nothing here is comparable with figures on ModelNet40" in text
    assert "(paper)" not in text
    assert notes(groups) == []


def test_the_worst_class_is_named(three_ways: Path) -> None:
    text = report_markdown(_groups(three_ways / "z_so3"), [])
    assert "- shapes/default: largest loss: bottle, 0.0 % accuracy." in text
    assert "| shapes/default | 0.0 | 100.0 | 50.0 |" in text
    console = Console(width=200, record=True, file=io.StringIO())
    for table in report_tables(_groups(three_ways)):
        console.print(table)
    shown = console.export_text()
    for words in ("z / SO3", "65.0 (± 5.0)", "largest loss: mug, 50.0 % accuracy"):
        assert words in shown


def test_the_papers_table_stands_beside_its_data(tmp_path: Path) -> None:
    for names, printed in ((MODELNET40, True), (MODELNET40[:10], False)):
        folder = _write(tmp_path / str(printed), 5, 0, "none", None, SHAPE_DATA, names)
        text = report_markdown(_groups(folder), [])
        assert ("| 5 | tangent images (paper) |  |  | 89.1 |  |  |  |" in text) is printed
        assert "| 5 | shapes/default | – / – | 0 | 62.5 | 66.7 | 40 | 1 |" in text


def test_csv_and_json_hold_the_same_shares(three_ways: Path) -> None:
    groups = _groups(three_ways)
    rows = list(csv.DictReader(io.StringIO(report_csv(groups))))
    read = {g["label"]: g for g in json.loads(report_json(groups, []))["groups"]}
    assert len(rows) == 3 * (2 + 3)
    for row in rows:
        group = read[row["group"]]
        figures = group["means"] if row["class"] == "mean" else group["classes"][row["class"]]
        assert float(row["mean"]) == figures[row["figure"]]["mean"]
        assert row["rotations"] == group["rotations"]
    assert "inputs" not in rows[0]


def test_the_chart_has_two_panels(three_ways: Path) -> None:
    encoded = np.frombuffer(report_png(_groups(three_ways)), np.uint8)
    picture = cv2.imdecode(encoded, cv2.IMREAD_COLOR)
    assert picture is not None
    blue = (picture == (0xB2, 0x72, 0x00)).all(-1)
    count, _, boxes, _ = cv2.connectedComponentsWithStats(blue.astype(np.uint8), connectivity=8)
    bars = [k for k in range(1, count) if boxes[k, cv2.CC_STAT_AREA] > 1000]
    assert len({boxes[k, cv2.CC_STAT_TOP] // 400 for k in bars}) == 2


def test_a_seed_that_is_there_twice_is_said(tmp_path: Path) -> None:
    _write(tmp_path / "a", 5)
    _write(tmp_path / "b", 6)
    assert notes(_groups(tmp_path)) == [
        f"shapes/default: seed 0 more than once, also in {tmp_path / 'b'}."
    ]


def test_results_of_other_kinds_are_reported_apart(three_ways: Path, tmp_path: Path) -> None:
    other = _write(tmp_path / "other", 5)
    content: dict[str, Any] = json.loads((other / "results.json").read_text())
    names = ("miou", "macc", "miou_solid_angle", "macc_solid_angle")
    figures = ("iou", "accuracy", "iou_solid_angle", "accuracy_solid_angle")
    content |= dict.fromkeys(names, 0.5)
    content["classes"] = [entry | dict.fromkeys(figures, 0.5) for entry in content["classes"]]
    del content["kind"]
    (other / "results.json").write_text(json.dumps(content))
    with pytest.raises(DataError, match=r"found results of segmentation; expected classification"):
        _groups(three_ways, other)
    assert _groups(other)[0].kind == "segmentation"
    (other / "results.json").write_text(json.dumps(content | {"kind": "detection"}))
    with pytest.raises(DataError, match="results of detection"):
        load_run(other)
