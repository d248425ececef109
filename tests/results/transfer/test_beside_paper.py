"""The paper's transfer: what was printed, and where it stands beside."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping
from statistics import fmean
from typing import Any

import pytest

from tangent_train.results.reports.paper import CLASSES
from tangent_train.results.transfer.beside_paper import paper_table, printed, printed_kept
from tangent_train.results.transfer.paper import SYNTHIA_ROWS, TRANSFER_STAGES, paper_stage
from tangent_train.results.transfer.report import TransferReport, gather
from tangent_train.results.transfer.tables import (
    transfer_csv,
    transfer_markdown,
    transfer_notes,
)
from tests.results.transfer.transfer_runs import REAL, by_name, make_run, markdown_tables, stage

FOLDS = (1, 2, 3)
STAGES = ("P", "S", "P-FT-1", "S-FT-1", "P-FT-10", "S-FT-10")


def real(
    names: tuple[str, ...] = STAGES,
    folds: tuple[int, ...] = FOLDS,
    settings: Mapping[str, Any] | None = None,
) -> TransferReport:
    run = make_run(0.5, names=CLASSES, settings={"data._target_": REAL, **(settings or {})})
    return gather([stage(name, run, fold) for name in names for fold in folds])


@pytest.mark.parametrize(
    ("name", "macc", "miou"),
    [
        ("P", 61.8, 45.7),
        ("S", 57.4, 42.3),
        ("S-FT-1", 61.2, 47.0),
        ("P-FT-10", 61.0, 47.1),
        ("S-FT-10", 64.0, 49.6),
    ],
)
def test_means_of_the_printed_folds(name: str, macc: float, miou: float) -> None:
    found = paper_stage(name)
    assert found is not None
    assert found.figure("macc", FOLDS) == pytest.approx(macc, abs=0.05)
    assert found.figure("miou", FOLDS) == pytest.approx(miou, abs=0.05)
    assert found.figure("miou_solid_angle", FOLDS) is None
    assert found.figure("miou", (1, 4)) is None
    assert found.figure("miou", (None,)) is None


def test_what_the_paper_keeps_without_fine_tuning() -> None:
    report = real()
    sphere = by_name(report)["S"]
    assert printed_kept(report, sphere, "macc") == pytest.approx(0.929, abs=5e-4)
    assert printed_kept(report, sphere, "miou") == pytest.approx(0.926, abs=5e-4)


def test_the_means_of_the_printed_classes_are_those_of_the_folds() -> None:
    """The per-class table is over all folds: it says what the rows "ALL FOLDS" should have been."""
    stages = [found for found in TRANSFER_STAGES if found.iou]
    assert [found.name for found in stages] == ["P", "S", "P-FT-10", "S-FT-10"]
    for found in stages:
        assert found.figure("miou", FOLDS) == pytest.approx(fmean(found.iou), abs=0.1)
        assert found.figure("macc", FOLDS) == pytest.approx(fmean(found.accuracy), abs=0.1)


@pytest.mark.parametrize(
    ("fold", "name", "macc", "miou"),
    [
        (1, "S", -2.5, -4.5), (1, "S-FT-1", 2.6, 0.0), (1, "S-FT-10", 8.9, 3.5),
        (2, "S", -17.2, -10.6), (2, "S-FT-1", -6.7, 2.5), (2, "S-FT-10", -1.9, 7.1),
        (3, "S", -2.6, -7.5), (3, "S-FT-1", 3.6, 0.6), (3, "S-FT-10", 7.2, 5.6),
    ],
)  # fmt: skip
def test_changes_are_those_printed(fold: int, name: str, macc: float, miou: float) -> None:
    """Within the rounding of what they were computed from, here from figures of one decimal."""
    report = real().of_fold(fold)
    row = by_name(report)[name]
    for figure, change in (("macc", macc), ("miou", miou)):
        kept = printed_kept(report, row, figure)
        assert kept is not None
        assert 100 * (kept - 1) == pytest.approx(change, abs=0.35)


@pytest.mark.parametrize(
    ("name", "figure", "changes"),
    [
        ("S", "accuracy", "-18.1 -20.2 -19.6 0.9 -0.3 -20.2 16.4 11.4 5.4 -0.1 -27.4 -7.1 -3.7"),
        ("S-FT-10", "accuracy", "83 -5.2 -4.3 -1.7 9.1 -8.1 72.7 30.2 3.1 21.9 -14.1 -0.9 6.9"),
        ("S", "iou", "-2.3 -4.7 -6.6 0.6 0.4 -6.9 -14.2 -11.7 -13 4.8 -8.5 -7 -20.8"),
        ("S-FT-10", "iou", "62.2 -3.4 4.6 13.9 13.2 2.7 2.8 4.9 7.7 22.5 0.3 2.5 -12.7"),
    ],
)
def test_changes_of_classes_are_those_printed(name: str, figure: str, changes: str) -> None:
    report = real()
    row = by_name(report)[name]
    for k, change in enumerate(map(float, changes.split())):
        kept = printed_kept(report, row, figure, k)
        assert kept is not None
        assert 100 * (kept - 1) == pytest.approx(change, abs=1.1)


def test_figures_stand_beside_the_same_stages_on_the_same_folds() -> None:
    tables = markdown_tables(transfer_markdown(real(("P", "S", "S other"), (1, 3))))
    assert tables["Fold 1"][0][-4:] == ["paper mAcc %", "change", "paper mIoU %", "change"]
    assert tables["Fold 1"][2][-4:] == ["60.2", "−2.4 %", "45.3", "−4.4 %"]
    # (60.2 + 64.2) / 2, (61.7 + 65.9) / 2; (45.3 + 47.3) / 2, (47.4 + 51.1) / 2
    assert tables["Mean of folds 1 and 3"][2][-4:] == ["62.2", "−2.5 %", "46.3", "−6.0 %"]
    assert tables["Mean of folds 1 and 3"][3][-4:] == ["–"] * 4
    classes = tables["The paper's classes: IoU %, mean of 3 folds"]
    assert classes[-1] == ["window", "50.1", "39.7", "−20.8 %", "51.6", "45.0", "−12.8 %"]
    assert len(classes) == 14


def test_the_csv_has_the_papers_classes_over_all_folds_only() -> None:
    rows = list(csv.DictReader(io.StringIO(transfer_csv(real()))))
    beside = {
        (row["stage"], row["fold"], row["class"], row["figure"]): float(row["paper"])
        for row in rows
        if row["paper"]
    }
    assert beside["S", "mean", "sofa", "iou"] == pytest.approx(0.233)
    assert beside["S", "2", "mean", "miou"] == pytest.approx(0.344)
    assert beside["S", "mean", "mean", "miou"] == pytest.approx(0.4233, abs=5e-5)
    # 6 stages, 3 folds and their mean, 2 means; 4 stages, 13 classes, 2 figures
    assert len(beside) == 6 * 4 * 2 + 4 * 13 * 2


@pytest.mark.parametrize(
    "changes",
    [
        {"data._target_": "datamodules.SynthRooms"},
        {"data.test_rotation": "so3"},
        {"names": CLASSES[:12]},
    ],
    ids=["made", "turned", "classes"],
)
def test_nothing_stands_beside_other_data(changes: dict[str, Any]) -> None:
    names = changes.pop("names", CLASSES)
    settings = {"data._target_": REAL} | changes
    runs = [stage(name, make_run(0.5, names=names, settings=settings)) for name in STAGES]
    report = gather(runs)
    assert paper_table(report) is None
    assert [printed(report, row, "miou") for row in report.rows] == [None] * 6
    assert not any("paper" in note for note in transfer_notes(report))


def test_a_stage_of_the_same_name_run_otherwise_is_another() -> None:
    settings = {"data._target_": REAL}
    run = make_run(0.5, names=CLASSES, settings=settings)
    report = gather([stage("P", run), stage("S", run, representation="erp")])
    assert [printed(report, row, "miou") for row in report.rows] == [0.474, None]


def test_other_settings_than_the_papers_are_said() -> None:
    (folds,) = transfer_notes(real())
    assert "repeat fold 3" in folds
    _, other = transfer_notes(real(settings={"level": 7, "data.inputs": ["rgb"]}))
    assert other == "The paper's transfer was run with level 8, here 7; inputs RGB-D, here RGB."


def synthia(level: int) -> TransferReport:
    settings = {"data._target_": "datamodules.OmniSynthia", "level": level}
    runs = [stage(name, make_run(0.5, settings=settings), None) for name in (*STAGES, "S-FT-3")]
    return gather(runs)


@pytest.mark.parametrize(
    ("level", "figures"),
    [
        (6, {"S": (0.552, 0.432), "S-FT-10": (0.594, 0.461)}),
        (7, {"S": (0.602, 0.449), "S-FT-10": (0.653, 0.502)}),
        (8, {"S": (0.708, 0.549), "S-FT-10": (0.732, 0.557)}),
        (9, {}),
    ],
)
def test_omnisynthia_stands_beside_by_level(level: int, figures: dict[str, Any]) -> None:
    report = synthia(level)
    found = {
        row.name: (printed(report, row, "macc"), printed(report, row, "miou"))
        for row in report.rows
    }
    expected: dict[str, Any] = dict.fromkeys((*STAGES, "S-FT-3"), (None, None)) | figures
    for name, pair in expected.items():
        assert found[name] == pytest.approx(pair)


def test_rivals_on_omnisynthia_stand_below() -> None:
    tables = markdown_tables(transfer_markdown(synthia(7)))
    rivals = tables["The paper's comparison on OmniSYNTHIA"]
    assert ["7", "Zhang et al.", "native", "57.1", "48.3"] in rivals
    assert len(rivals) == 1 + len(SYNTHIA_ROWS) == 13
    assert tables["One test set"][0][-2:] == ["paper mAcc %", "paper mIoU %"]
    assert tables["One test set"][2][-2:] == ["60.2", "44.9"]
