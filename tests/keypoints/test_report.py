"""Tables of keypoints: splits, means over pairs, what stands beside the paper's figures."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from datamodules.stanford2d3ds.pairs import published_pairs
from tangent_train.keypoints.compare import AS_GIVEN, SHRUNK, Row
from tangent_train.keypoints.report import with_splits, write_report

PUBLISHED = {str(pair.number): pair for pair in published_pairs()}


def row(pair: str = "a", representation: str = "ERP", **figures: Any) -> Row:
    errors = ("rotation_error_deg", "translation_error_deg", "correct_share")
    areas = (f"pose_auc_{degrees}" for degrees in (5, 10, 20))
    base = dict.fromkeys(("split", "fov_overlap", *errors, *areas))
    scores = {"pmr": 0.2, "ms": 0.1, "p": 0.5, "inliers": 20, "keypoints_left": 100}
    kind = {"pair": pair, "representation": representation, "condition": AS_GIVEN}
    return {**base, **scores, **kind, "visible_by": "depth", **figures}


def of_paper() -> list[Row]:
    """Rows of a run that reproduces the paper's figures of every pair."""
    rows = []
    for name, pair in PUBLISHED.items():
        given: Any = {"split": pair.split, "fov_overlap": pair.fov_overlap}
        for representation, (pmr, ms, p) in pair.scores.items():
            rows.append(row(name, representation, pmr=pmr, ms=ms, p=p, **given))
            if representation == "ERP":
                rows.append(row(name, SHRUNK, pmr=0.9, **given))
    return rows


def tables(markdown: str) -> dict[str, list[list[str]]]:
    found: dict[str, list[list[str]]] = {}
    for block in markdown.split("\n## ")[1:]:
        lines = [line for line in block.splitlines() if line.startswith("|")]
        cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
        found[block.partition("\n")[0]] = [line for line in cells if "---" not in line[0]]
    return found


def test_the_half_with_the_smaller_overlaps_is_hard() -> None:
    def splits(*overlaps: float | None) -> list[Any]:
        rows = [row(str(k), fov_overlap=overlap) for k, overlap in enumerate(overlaps)]
        return [one["split"] for one in with_splits(rows)]

    assert splits(0.9, 0.5, 0.7, 0.8, 0.6) == ["easy", "hard", "easy", "easy", "hard"]
    assert splits(0.5, 0.5, 0.5, 0.9) == ["hard", "hard", "easy", "easy"]
    for unknown in ((0.5,), (0.5, 0.5), (None, 0.5, 0.9), ()):
        assert splits(*unknown) == [None] * len(unknown)
    given = [row("a", split="hard", fov_overlap=0.9), row("b", split="easy", fov_overlap=0.1)]
    assert with_splits(given) == given


def test_the_papers_figures_stand_beside_ours(tmp_path: Path) -> None:
    write_report(tmp_path, of_paper(), {"seed": 0}, PUBLISHED)
    found = tables((tmp_path / "keypoints.md").read_text())
    table = found["As they are"]
    assert table[0] == ["split", "metric", "ERP", "ERP ×0.71", "L0", "L1", "L2"]
    assert table[1] == ["hard (30)", "PMR %", "22.3", "90.0", "28.7", "30.0", "27.5"]
    assert table[2] == ["", "PMR %, paper", "22.2", "–", "28.4", "30.1", "27.4"]
    easy = table[[line[0] for line in table].index("easy (30)") :]
    assert easy[5][1:] == ["P %, paper", "46.0", "–", "46.4", "47.5", "46.5"]
    pairs = found["Per pair: as they are"]
    assert len(pairs) == 1 + 2 * 60
    assert pairs[1][:4] == ["0", "hard", "83.0", "25.0 / 12.0 / 51.0"]
    assert pairs[2][:5] == ["paper", "", "83.0", "25.0 / 12.0 / 51.0", "–"]
    overlap = "overlap of the fields of view %"
    assert ["", overlap, "83.6", "83.6", "83.6", "83.6", "83.6"] in table
    assert ["", f"{overlap}, paper", "83.4", "–", "–", "–", "–"] in table
    assert ["", "inliers, paper", "298", "–", "–", "–", "–"] in table
