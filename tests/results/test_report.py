"""Reports over runs, transfers and levels: tables, files, the paper's figures, the chart."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from statistics import fmean
from typing import Any

import pytest
import yaml  # type: ignore[import-untyped]

from datamodules.modelnet40.shapes import MODELNET40
from datamodules.stanford2d3ds.files import CLASSES
from tangent_train.files import write_text
from tangent_train.heads import ClassesHead, DistanceHead, ImageClassHead
from tangent_train.results.chart import report_png
from tangent_train.results.evaluation import EvaluationResult, load_result
from tangent_train.results.published import (
    facts,
    published_lines,
    published_rows,
    published_table,
)
from tangent_train.results.report import Report, levels_report, runs_report, transfer_report
from tangent_train.results.rows import RunRow
from tests.decoded import decoded
from tests.results.example_results import PROTOCOL, example_result, without_solid_angle

REAL = CLASSES


def _runs_report(*records: EvaluationResult) -> Report:
    return runs_report(records, ["a note"])


def _cells(report: Report, table: int = 0) -> dict[str, dict[str, str]]:
    """By row and column."""
    found = report.tables()[table]
    return {row[0]: dict(zip(found.header[1:], row[1:], strict=True)) for row in found.rows}


def _paper(**settings: Any) -> dict[str, RunRow]:
    """The paper's transfer by stage, as it stands beside one of that level."""
    record = example_result([0.5] * 13, REAL, **{"level": 8, "protocol": PROTOCOL, **settings})
    photos = replace(record, protocol=facts("paper_photos"))
    rows = transfer_report({"P": [photos], "S": [record]}).rows
    return {r.label.removesuffix(" (paper)"): r for r in rows if r.label.endswith("(paper)")}


def test_the_tables_show_means_spreads_and_missing_folds() -> None:
    report = _runs_report(
        example_result([0.1, 0.5, 0.5], data__fold=1),
        example_result([0.3, 0.5, None], data__fold=3),
        example_result([0.3, 0.5, None], data__fold=3, seed=1),
        example_result([0.3, 0.5, None], data__fold=3, seed=1),
    )
    cells = _cells(report)["mine"]
    assert cells["mIoU %"] == "38.3 ± 2.4 (± 0.0)"
    note = report.means().note
    assert note.startswith("data Stanford2D3DS; s 7; input RGB-D; b 0; folds 1, 3; runs 4. Percent")
    classes = {"wall": "20.0 ± 14.1 (± 0.0)", "floor": "50.0 ± 0.0 (± 0.0)", "sofa": "50.0 of 1"}
    assert [_cells(report, k)["mine"] for k in (2, 3)] == [classes] * 2
    assert report.notes == [
        "mine: fold 2 missing; not a mean of 3 folds.",
        "a note",
    ]


def test_folds_are_those_of_the_data_set() -> None:
    """Own data with folds 4 and 5, and data without folds."""
    results = [example_result([0.5] * 3, folds=(4, 5), data__fold=fold) for fold in (4, 5)]
    assert runs_report(results).notes == []
    assert runs_report(results[:1]).notes == ["mine: fold 5 missing; not a mean of 2 folds."]
    assert transfer_report({"S": results[1:]}).notes == [
        "S: fold 4 missing; not a mean of 2 folds."
    ]
    assert runs_report([example_result([0.5] * 3, folds=(), data__fold=None)]).notes == []


def test_a_single_run_is_shown_with_its_interval_over_images() -> None:
    def run(found: dict[str, tuple[float, float]], **settings: Any) -> EvaluationResult:
        return replace(example_result([0.1, 0.5, 0.5], **settings), intervals=found)

    intervals = {"miou": (0.25, 0.31)}  # a mean of few images may lie outside
    several = [run(intervals, data__fold=fold) for fold in (1, 2)]
    report = _runs_report(run(intervals, name="single"), *several)
    cells = _cells(report)
    assert cells["single"]["mIoU %"] == "36.7 [25.0, 31.0]"
    assert cells["single"]["mAcc %"] == "36.7"
    assert cells["mine"]["mIoU %"] == "36.7 ± 0.0"
    explained = "95 % bootstrap interval over its images"
    assert explained in report.means().note
    assert explained not in _runs_report(*several).means().note


def test_published_rows_stand_beside_the_same_protocol_and_level() -> None:
    report = _runs_report(example_result([0.5] * 13, REAL, protocol=PROTOCOL))
    cells = _cells(report)
    assert set(cells) == {
        "tangent images (paper)", "Tateno et al. (paper)", "Lee et al. (paper)", "mine",
    }  # fmt: skip
    published = cells["tangent images (paper)"]
    assert (published["b"], published["mAcc %"], published["mIoU %"]) == ("0", "59.1", "44.9")
    assert cells["Lee et al. (paper)"]["mIoU %"] == "–"
    per_class = _cells(report, 2)["tangent images (paper)"]
    assert (per_class["beam"], per_class["board"]) == ("30.4", "57.2")
    source = "Published scores of the same protocol: https://arxiv.org/abs/1912.09390."
    assert source in report.notes


@pytest.mark.parametrize("name", ["size", "mask", "another"])
def test_scores_with_one_differing_fact_are_not_shown_and_the_fact_is_named(name: str) -> None:
    result = example_result([0.5] * 13, REAL, protocol=PROTOCOL | {name: "changed"})
    rows, (first, *others) = published_rows([result])
    assert rows == []
    assert first == (
        "Not comparable: tangent images: 44.9 and 2 more (paper_512). "
        f"{name}: published {PROTOCOL.get(name, '–')}, this run changed."
    )
    assert 1 <= len(others) <= 2


def test_a_fold_without_a_published_score_is_named() -> None:
    protocol = facts("stanford2d3ds_trans4pass")
    result = example_result([0.5] * 13, REAL, protocol=protocol, data__fold=2)
    (row,), _ = published_rows([result])
    assert row.label == "Trans4PASS+ (S) (paper)"
    assert row.score("miou").mean == pytest.approx(0.54)
    table = published_table([row], result)
    assert table.rows == [("Trans4PASS+ (S) (paper)", "RGB", "47.7")], "of the run's fold"
    rows, notes = published_rows([result], transfer=True)
    assert rows == []
    assert "fold: published 1, this run 2." in notes[0]
    rows, _ = published_rows([replace(result, settings={"data.fold": 1})], transfer=True)
    assert {row.label for row in rows} >= {
        "Trans4PASS+ (S), trained on photos of Stanford2D3DS (paper)"
    }


def test_facts_in_which_runs_differ_are_columns_of_all_rows() -> None:
    other = example_result([0.5] * 13, REAL, protocol=PROTOCOL | {"mask": "-60"}, data__mask=-60)
    report = _runs_report(example_result([0.5] * 13, REAL, protocol=PROTOCOL), other)
    assert {label: row["mask"] for label, row in _cells(report).items()} == {
        "mine (data.mask=None)": "none",
        "mine (data.mask=-60)": "-60",
        **dict.fromkeys(
            ("tangent images (paper)", "Tateno et al. (paper)", "Lee et al. (paper)"), "none"
        ),
    }


def test_every_published_score_has_a_protocol_its_data_and_a_known_unit() -> None:
    columns = {**ClassesHead.columns, **DistanceHead.columns, **ImageClassHead.columns}
    for line in published_lines():
        assert facts(line["protocol"])["data"] == line["data"]
        assert line["source"].startswith("https://")
        least, most = (1, 100) if columns[line["score"]].unit == "%" else (0, 1)
        assert not line["mean"] or least < float(line["mean"]) < most


def test_published_depth_stands_beside_the_same_range_and_alignment() -> None:
    columns, scores = DistanceHead.columns, dict.fromkeys(DistanceHead.columns, 0.25)
    protocol = facts("stanford2d3ds_depth_dap")
    result = EvaluationResult("panoramas", 373, columns, scores, protocol=protocol)
    result = replace(result, settings={"data.fold": 1})
    (row,), _ = published_rows([result])
    assert row.label == "DAP (paper)"
    assert [row.score(name).mean for name in ("absrel", "delta1")] == [0.0921, 0.9135]
    rows, notes = published_rows([replace(result, protocol=protocol | {"range": "0 to 10 m"})])
    assert rows == []
    assert notes[0].endswith("range: published 0 to 100 m, this run 0 to 10 m.")


@pytest.mark.parametrize(("name", "macc", "miou"), [("P", 61.8, 45.7), ("S-FT-10", 64.0, 49.6)])
def test_the_papers_transfer_is_the_mean_of_its_printed_folds(
    name: str, macc: float, miou: float
) -> None:
    row = _paper()[name]
    assert row.folds == (1, 2, 3)
    assert row.score("macc").mean == pytest.approx(macc / 100, abs=5e-4)
    assert row.score("miou").mean == pytest.approx(miou / 100, abs=5e-4)
    # The table per class is over all folds.
    classes = fmean(row.score("iou", label).mean or 0.0 for label in REAL)
    assert classes == pytest.approx(miou / 100, abs=1e-3)


def test_a_transfer_compares_panoramas_with_photos_of_as_much_fine_tuning() -> None:
    photos = without_solid_angle(example_result([0.4, 0.8, 0.6]))
    sphere = example_result([0.3, 0.8, 0.4], bands=(0.1, 0.2))
    tuned = example_result([0.8, 0.8, 0.8])
    stages = {"P": [photos], "S": [sphere], "S-erp": [tuned], "S-FT-10": [tuned]}
    report = transfer_report(stages)
    table = report.means()
    change = table.header.index("change", table.header.index("mIoU %"))
    assert [row[change] for row in table.rows] == ["–", "−16.7 %", "+33.3 %", "–"]
    assert [row.partner and row.partner.label for row in report.rows] == [None, "P", "P", None]


def test_scores_of_the_sphere_are_columns_for_every_view() -> None:
    """With the interval of a single run; photos and undefined scores are left out."""
    photos = without_solid_angle(example_result([0.4, 0.8, 0.6]))
    photos = replace(photos, scores={"miou": 0.6})
    upright = replace(example_result([0.3] * 3), intervals={"seam_step": (-0.1, 0.2)})
    upright = replace(upright, scores={"miou": 0.3, "seam_step": 0.05, "pole_gap": -0.2})
    tilted = replace(upright, scores={**upright.scores, "pole_gap": None}, intervals={})
    stages = {"P": [photos], "S": [upright], "S-erp": [tilted], "S-erp-tilted": [tilted]}
    cells = {"S": ("S", "upright"), "S-erp": ("erp", "upright"), "S-erp-tilted": ("erp", "tilted")}
    report = transfer_report(stages, cells)
    table = report.sphere()
    assert table.title == "On the sphere upright"
    assert table.header == ("", "mIoU near the poles, minus horizon %", "step across the seam % ↓")
    assert table.rows == [("S", "-20.0", "5.0 [-10.0, 20.0]"), ("S-erp", "–", "5.0")]
    assert table in report.tables()
    everywhere = replace(report, cells={}).sphere()
    assert [row[0] for row in everywhere.rows] == ["S", "S-erp", "S-erp-tilted"]
    assert not transfer_report({"P": [photos]}).sphere().rows


def test_reports_of_shapes_have_the_published_scores_of_the_same_rotation() -> None:
    classes = [{"class": name, "images": 3, "accuracy": 0.5} for name in MODELNET40]
    settings = {
        "data._target_": "datamodules.modelnet40.shapes.ModelNet40",
        "level": 5,
        "name": "shapes",
    }
    settings["representation.base_level"] = 0
    scores = {"accuracy": 0.8, "class_accuracy": 0.7}
    columns = ImageClassHead.columns
    result = EvaluationResult("shapes", 120, columns, scores, classes, settings=settings)
    aligned = replace(result, protocol=facts("paper_modelnet40"))
    rotated = replace(result, protocol={**aligned.protocol, "test_rotation": "so3"})
    assert published_rows([rotated])[0] == []
    cells = _cells(_runs_report(aligned))
    assert cells["shapes"]["accuracy %"] == "80.0"
    assert cells["shapes"]["mean over classes %"] == "70.0"
    assert cells["tangent images (paper)"]["accuracy %"] == "89.1"
    assert len(cells) == 5


def test_levels_are_compared_with_the_level_of_the_photos() -> None:
    levels = {8: [example_result([0.4] * 3)], 7: [example_result([0.8] * 3)]}
    table = levels_report(levels, 7.3).means()
    change = table.header.index("change")
    assert [(row[0], row[change]) for row in table.rows] == [
        ("level 7", "–"),
        ("level 8", "−50.0 %"),
    ]


def test_the_chart_shows_a_bar_of_the_right_height() -> None:
    def blue_rows(share: float) -> int:
        result = example_result([share] * 3)
        rows = [RunRow.of("$a$ " * 30, [result], {})]
        blue = (decoded(report_png("Report", rows, result)) == (0x00, 0x72, 0xB2)).all(-1)
        return int(blue.any(1).sum())

    low, middle, high = map(blue_rows, (0.0, 0.4, 0.8))  # two rows of axes, the legend's handle
    assert high - middle == pytest.approx(middle - low, abs=8)
    assert high - low > 200


def test_errors_are_marked_and_only_main_scores_are_columns(tmp_path: Path) -> None:
    """Depth: no classes, no published scores of the data set, and smaller errors are better."""
    columns = DistanceHead.columns
    means = dict.fromkeys(columns, 0.25)
    protocol = {"data": "SynthRooms", "alignment": "none"}
    settings = {"name": "mine", "seed": 0, "level": 6, "data": {"fold": 1}}
    records = []
    for number, alignment in enumerate(("none", "median in distance")):
        folder = tmp_path / str(number)
        written = EvaluationResult("panoramas", 2, columns, means, protocol=protocol)
        written = replace(written, protocol=protocol | {"alignment": alignment})
        write_text(folder / "results.json", written.json())
        content = settings | {"task": {"alignment": alignment}}
        (folder / "config.yaml").write_text(yaml.safe_dump(content))
        records.append(load_result(folder))
    assert records[0].columns == columns
    assert records[0].scores == means
    assert published_rows(records) == ([], [])
    report = runs_report(records)
    header, rows = report.means().header, report.means().rows
    assert header[-6:] == (
        *("AbsRel ↓", "δ1 %", "RMSE m ↓"),
        *("AbsRel by solid angle ↓", "δ1 by solid angle %", "RMSE by solid angle m ↓"),
    )
    assert [row[-6:-3] for row in rows] == [("0.25", "25.0", "0.25")] * 2
    assert {"none", "median in distance"} <= {cell for row in rows for cell in row}
    assert {line["score"] for line in report.csv_lines()} == {*columns}, "the CSV file has all"
