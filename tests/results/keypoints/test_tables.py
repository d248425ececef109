"""Tables of keypoints: splits, means over pairs, what stands beside the paper's figures."""

from __future__ import annotations

import csv
import io
import json
import math
from dataclasses import replace

import numpy as np
import pytest

from datamodules.stanford2d3ds.pairs import published_pairs
from tangent_train.results.keypoints.entries import (
    AS_GIVEN,
    EASY,
    HARD,
    TURNED,
    PairEntry,
    defined,
    with_splits,
)
from tangent_train.results.keypoints.means import PAPER, PAPER_STATISTICS, SplitMeans, splits_of
from tangent_train.results.keypoints.representations import Representations, shrunk_rows
from tangent_train.results.keypoints.tables import KeypointReport, overall_cells, pairs_csv
from tests.results.keypoints.made_entries import entry, scored

PUBLISHED = {str(pair.number): pair for pair in published_pairs()}
REPRESENTATIONS = ("ERP", "ERP_shrunk", "L0", "L1", "L2")


def _of_paper() -> list[PairEntry]:
    """What a run would give that reproduced the paper's single figures."""
    return [
        entry(
            name,
            [
                *(scored(rep, *figures) for rep, figures in pair.scores.items()),
                scored("ERP_shrunk", 0.9),
            ],
            pair.fov_overlap,
            pair.split,
            has_geometry=True,
        )
        for name, pair in PUBLISHED.items()
    ]


def _rows(markdown: str, start: str) -> list[list[str]]:
    lines = markdown.partition(start)[2].lstrip("\n").splitlines()
    table: list[list[str]] = []
    for line in lines:
        if not line.startswith("|") and table:
            break
        if line.startswith("|"):
            table.append([cell.strip() for cell in line.strip("|").split("|")])
    return [row for row in table if set(row[0]) != {"-"}]


# The split at the median.


def test_the_half_with_the_smaller_overlaps_is_hard() -> None:
    overlaps = [0.9, 0.5, 0.7, 0.8, 0.6]
    entries = with_splits([entry(str(k), [], o) for k, o in enumerate(overlaps)])
    assert [e.split for e in entries] == [EASY, HARD, EASY, EASY, HARD]
    ties = with_splits([entry(str(k), [], o) for k, o in enumerate((0.5, 0.5, 0.5, 0.9))])
    assert [e.split for e in ties] == [HARD, HARD, EASY, EASY]


@pytest.mark.parametrize("overlaps", [[0.5], [0.5, 0.5], [None, 0.5, 0.9], [None, None], []])
def test_nothing_is_divided_where_overlaps_do_not_say(overlaps: list[float | None]) -> None:
    entries = [entry(str(k), [], overlap) for k, overlap in enumerate(overlaps)]
    assert [e.split for e in with_splits(entries)] == [None] * len(overlaps)


def test_splits_of_the_data_stay_and_failed_pairs_are_left_out() -> None:
    entries = [entry("a", [], 0.9, HARD), entry("b", [], 0.1, EASY), PairEntry("c", error="broken")]
    assert [e.split for e in with_splits(entries)] == [HARD, EASY]


# Means.


def test_means_leave_out_what_is_not_defined() -> None:
    found = [entry("a", [scored("ERP", 0.2)]), entry("b", [scored("ERP", None)])]
    found.append(entry("c", [scored("ERP", 0.6)]))
    (split,) = splits_of(found)
    assert split.split is None
    assert split.mean(AS_GIVEN, "ERP", lambda s: s.pmr) == pytest.approx(0.4)
    assert split.median(AS_GIVEN, "ERP", lambda s: s.pmr) == pytest.approx(0.4)
    assert split.mean(AS_GIVEN, "L0", lambda s: s.pmr) is None
    assert split.mean(TURNED, "ERP", lambda s: s.pmr) is None
    assert split.median(TURNED, "ERP", lambda s: s.pmr) is None
    assert split.fov_overlap is None


def test_splits_come_in_the_order_of_the_paper() -> None:
    names = ["other", EASY, None, HARD, "another"]
    found = [entry(str(k), [], split=name) for k, name in enumerate(names)]
    assert [s.split for s in splits_of(found)] == [HARD, EASY, "another", "other", None]


def test_the_papers_table_has_the_means_of_its_single_figures() -> None:
    for split in splits_of(_of_paper()):
        assert split.split is not None
        assert PAPER_STATISTICS[split.split][0] == len(split.entries)
        for k, score in enumerate(("pmr", "ms", "p")):
            for representation, printed in zip(
                ("ERP", "L0", "L1", "L2"), PAPER[split.split][score], strict=True
            ):
                mean = split.mean(AS_GIVEN, representation, lambda s: getattr(s, score))  # noqa: B023
                assert mean is not None
                assert abs(mean - printed) < 0.003, (split.split, representation, k)


# The tables themselves.


def test_the_papers_figures_stand_beside_ours() -> None:
    report = KeypointReport(tuple(_of_paper()), REPRESENTATIONS, PUBLISHED, "Detector sift.")
    text = report.markdown()
    table = _rows(text, "## As they are")
    assert table[0] == ["split", "metric", "ERP", "ERP ×0.71", "L0", "L1", "L2"]
    assert table[1] == ["hard (30)", "PMR %", "22.3", "**90.0**", "28.7", "30.0", "27.5"]
    assert table[2] == ["", "PMR %, paper", "22.2", "–", "28.4", "30.1", "27.4"]
    easy = table[[row[0] for row in table].index("easy (30)") :]
    assert easy[5][1:] == ["P %, paper", "46.0", "–", "46.4", "47.5", "46.5"]
    pairs = _rows(text, "## Per pair: as they are")
    assert len(pairs) == 1 + 2 * 60
    assert pairs[1][:4] == ["0", "hard", "83.0", "25.0 / 12.0 / 51.0"]
    assert pairs[2] == ["paper", "", "83", "25 / 12 / 51", "–", *["28 / 14 / 50"], *pairs[2][6:]]
    assert _rows(text, "# Keypoints")[1:3] == [
        ["hard", "30", "83.6", "20"],
        ["paper", "30", "83.35", "298"],
    ]
    assert "Detector sift." in text
    assert "by depth and pose, occlusion heeded" in text


def test_other_data_have_nothing_of_the_papers() -> None:
    found = [
        entry(
            name,
            [
                scored("ERP", 0.2, rotation_error_deg=turn, judged=10, correct=5),
                scored("L0", 0.4, condition=TURNED),
            ],
            0.5 + 0.1 * k,
            has_geometry=True,
        )
        for k, (name, turn) in enumerate((("a|b", 1.0), ("c", 2.0)))
    ]
    report = KeypointReport(tuple(found), ("ERP", "L0"), {})
    text = report.markdown()
    assert "paper" not in text
    table = _rows(text, "## As they are")
    assert [row[:2] for row in table[1:5]] == [
        ["hard (1)", "PMR %"],
        ["", "MS %"],
        ["", "P %"],
        ["", "right matches %"],
    ]
    assert ["", "rotation error °, median", "1.00", "–"] in table
    assert ["", "rotation error °, median", "2.00", "–"] in table
    assert overall_cells(report, TURNED)[1] == ("hard (1)", "PMR %", "–", "**40.0**")
    assert r"a\|b" in text


def test_pairs_without_depth_say_so_and_failed_ones_are_named() -> None:
    found = (entry("a – b", [scored("ERP", 0.2)]), PairEntry("c – d", error="c.jpg: found a hole"))
    text = KeypointReport(found, ("ERP",), {}).markdown()
    assert "n_L and n_R are all keypoints" in text
    assert _rows(text, "## As they are")[1] == ["all (1)", "PMR %", "20.0"]
    assert ["c – d", "c.jpg: found a hole"] in _rows(text, "## Pairs that could not be used")
    assert _rows(text, "## Per pair")[1] == ["a – b", "–", "–", "20.0 / 10.0 / 50.0"]


def test_csv_holds_every_figure() -> None:
    rows = list(csv.DictReader(io.StringIO(pairs_csv(_of_paper(), PUBLISHED))))
    assert len(rows) == 60 * 5
    first = rows[1]
    assert first["pair"] == "0"
    assert (first["representation"], first["pmr"], first["pmr_paper"]) == ("L0", "0.28", "0.28")
    assert (first["fov_overlap"], first["visible_by"], first["keypoints_right"]) == (
        "0.83",
        "depth",
        "120",
    )
    shrunk = next(row for row in rows if row["representation"] == "ERP_shrunk")
    assert shrunk["pmr_paper"] == shrunk["rotation_error_deg"] == ""
    turned = [entry("0", [scored("ERP", 0.2, condition=TURNED)])]
    (row,) = csv.DictReader(io.StringIO(pairs_csv(turned, PUBLISHED)))
    assert (row["pmr_paper"], row["visible_by"], row["geometry"]) == (
        "",
        "all keypoints",
        "general",
    )


# What is kept in results.json.


def test_entries_come_back_from_json() -> None:
    for made in (*_of_paper()[:2], PairEntry("x", error="broken")):
        plain = json.loads(json.dumps(made.as_dict(), allow_nan=False))
        assert PairEntry.of(plain) == made
    assert [defined(value) for value in (math.nan, math.inf, np.float64(0.5))] == [None, None, 0.5]
    with pytest.raises(TypeError):
        PairEntry.of({"name": "x", "unknown": 1})


def test_the_share_of_right_matches() -> None:
    assert scored("ERP", 0.1, judged=8, correct=6).correct_share == 0.75
    assert scored("ERP", 0.1, judged=0, correct=0).correct_share is None
    assert scored("ERP", 0.1).correct_share is None
    assert SplitMeans(None, ()).mean(AS_GIVEN, "ERP", lambda s: s.pmr) is None
    assert replace(scored("ERP", 0.1), pmr=None).pmr is None


# What keypoints are detected on.


@pytest.mark.parametrize(("level", "rows"), [(10, 1453), (8, 363), (5, 45)])
def test_the_shrunk_panorama_has_the_pixels_of_tangent_images(level: int, rows: int) -> None:
    # R_v(−1) = 2 R_v(0) = 2.2142974 radians across 2^s pixels (DESIGN, section 3).
    assert shrunk_rows(level) == rows == round(math.pi / (2.2142974 / 2**level))


def test_names_of_representations() -> None:
    from tangent_train.keypoints.detectors import Detector

    detector = Detector("sift")
    assert Representations((0, 2), detector, 32, shrunk=True).names == [
        "ERP",
        "ERP_shrunk",
        "L0",
        "L2",
    ]
    assert Representations((1,), detector, 32, shrunk=False).names == ["ERP", "L1"]
