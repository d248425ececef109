"""One network at several levels, against figures worked out by hand."""

from __future__ import annotations

import csv
import io
import json

import pytest
from rich.console import Console

from tangent_train.errors import DataError
from tangent_train.results.transfer.levels import (
    LevelReport,
    LevelResult,
    gather_levels,
    levels_csv,
    levels_json,
    levels_markdown,
    levels_notes,
    levels_tables,
)
from tests.results.transfer.transfer_runs import levels, make_run, markdown_tables


@pytest.fixture
def three_levels() -> LevelReport:
    """Levels 7, 8 and 9 with two folds, the first of two seeds."""
    figures = {7: (0.2, 0.4, 0.5), 9: (0.3, 0.3, 0.6), 8: (0.4, 0.6, 0.7)}
    runs = ((1, 0), (1, 1), (2, 0))
    by_run = {
        (level, *key): value
        for level, values in figures.items()
        for key, value in zip(runs, values, strict=True)
    }
    return levels(by_run, 8.4)


def test_levels_are_compared_with_the_one_nearest_to_training(three_levels: LevelReport) -> None:
    assert [row.level for row in three_levels.rows] == [7, 8, 9]
    coarse, trained, fine = three_levels.rows
    assert three_levels.nearest.level == 8
    assert coarse.figure("miou").mean == pytest.approx((0.3 + 0.5) / 2)
    assert coarse.figure("miou").over_seeds == pytest.approx(0.02**0.5)
    assert coarse.figure("miou").over_folds == pytest.approx(0.02**0.5)
    assert coarse.kept("miou").mean == pytest.approx(0.4 / 0.6)
    assert fine.kept("miou").mean == pytest.approx(0.45 / 0.6)
    assert trained.kept("miou").mean is None


@pytest.mark.parametrize(("trained", "nearest"), [(6.9, 7), (8.0, 8), (8.49, 8), (12.0, 9)])
def test_the_nearest_level(trained: float, nearest: int) -> None:
    report = levels({(level, 1, 0): 0.5 for level in (9, 8, 7)}, trained)
    assert report.nearest.level == nearest


def test_the_table_says_the_level_of_training(three_levels: LevelReport) -> None:
    text = levels_markdown(three_levels)
    assert "the angular resolution of level 8.4." in text
    assert "Made rooms" in text
    table = markdown_tables(text.split("| level | fold |")[0])["One network at several levels"]
    assert table[0] == [
        "level", "mAcc %", "change from level 8", "mIoU %", "change from level 8",
        "mIoU % by solid angle", "runs",
    ]  # fmt: skip
    assert table[1][3:] == ["40.0 ± 14.1 (± 14.1)", "−33.3 %", "20.0 ± 7.1 (± 7.1)", "3"]
    assert table[2][4] == "–"
    # 0.55 and 0.7, both 0.1 higher than their mIoU.
    assert table[3][1:3] == ["55.0 ± 21.2 (± 0.0)", "−21.4 %"]
    assert levels_notes(three_levels) == []


def test_levels_without_all_folds_say_so() -> None:
    report = levels({(7, 1, 0): 0.3, (8, 1, 0): 0.5, (8, 2, 0): 0.9}, 8.0)
    (note,) = levels_notes(report)
    assert note.startswith("Level 7: 1 of 2 folds and seeds")
    text = levels_markdown(report)
    assert f"- {note}" in text
    # Against fold 1 alone.
    assert "| 7 | 40.0 of 1 | −33.3 % | 30.0 of 1 | −40.0 % | 15.0 of 1 | 1 |" in text


def test_csv_and_json_hold_the_same_shares(three_levels: LevelReport) -> None:
    rows = list(csv.DictReader(io.StringIO(levels_csv(three_levels))))
    assert len(rows) == 3 * 3 * 4
    read = json.loads(levels_json(three_levels))
    assert (read["made_by"], read["study"]) == ("tangent-transfer", "levels")
    assert (read["trained_level"], read["compared_with"]) == (8.4, 8)
    found = {
        (str(entry["level"]), str(scope["fold"])): scope["means"]
        for entry in read["levels"]
        for scope in entry["scopes"]
    }
    for row in rows:
        figure = found[row["level"], row["fold"]][row["figure"]]
        assert float(row["mean"]) == figure["mean"]
        kept = figure["kept"]["mean"]
        assert row["kept"] == ("" if kept is None else str(kept))
    assert found["7", "1"]["miou"]["mean"] == pytest.approx(0.3)
    assert found["7", "1"]["miou"]["kept"]["mean"] == pytest.approx(0.6)
    assert [len(entry["runs"]) for entry in read["levels"]] == [3, 3, 3]


def test_the_table_for_the_terminal(three_levels: LevelReport) -> None:
    console = Console(width=140, record=True, file=io.StringIO())
    for table in levels_tables(three_levels):
        console.print(table)
    assert "60.0 ± 14.1 (± 14.1)" in console.export_text()


def test_what_cannot_be_one_report_is_refused() -> None:
    with pytest.raises(DataError, match="found no evaluation"):
        gather_levels([], 8.0)
    run = make_run(0.5)
    with pytest.raises(DataError, match="found level 7 of fold 1, seed 0; expected each once"):
        gather_levels([LevelResult(7, 1, 0, run), LevelResult(7, 1, 0, run)], 8.0)
    other = make_run(0.5, names=("wall", "road"))
    with pytest.raises(DataError, match="found classes wall, road"):
        gather_levels([LevelResult(7, 1, 0, run), LevelResult(8, 1, 0, other)], 8.0)
