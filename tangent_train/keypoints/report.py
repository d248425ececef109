"""Write the scores of keypoints as the paper's tables, and draw matches."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from datamodules.core.panorama_pairs import PublishedPair
from tangent_train.files import csv_text, write_text
from tangent_train.keypoints.compare import AS_GIVEN, AUC_DEG, ROTATED, Comparison, Row
from tangent_train.results.tables import Table, markdown_text, percent

_CONDITIONS = {AS_GIVEN: "As they are", ROTATED: "Right panorama randomly rotated"}
_SCORES = ("pmr", "ms", "p")
_METRICS = {
    "PMR %": "pmr",
    "MS %": "ms",
    "P %": "p",
    "right matches %": "correct_share",
    "keypoints, left": "keypoints_left",
    "inliers": "inliers",
    "overlap of the fields of view %": "fov_overlap",
    "rotation error °, median": "rotation_error_deg",
    "translation error °, median": "translation_error_deg",
    **{f"pose AUC {degrees}° %": f"pose_auc_{degrees}" for degrees in AUC_DEG},
}
"""Columns of the rows by their name in tables."""

_VISIBLE = {
    "depth": "n_L and n_R are the keypoints visible to the other panorama, by depth and pose and "
    "with occlusion.",
    "all keypoints": "n_L and n_R are all keypoints, as depth and pose are unknown: PMR and MS are "
    "smaller than among the visible ones.",
}
"""Notes on n_L and n_R above the tables."""

_MOST_LINES = 150


def write_report(
    folder: Path,
    rows: Sequence[Row],
    settings: Mapping[str, Any],
    published: Mapping[str, PublishedPair],
) -> list[Table]:
    """Write ``results.json``, ``pairs.csv`` and ``keypoints.md`` of the pairs of one data set.

    Args:
        folder: Output folder.
        rows: Rows of `Comparer.compare` for all pairs.
        settings: Settings that affect the scores.
        published: The paper's pairs by name; empty for other data.

    Returns:
        Tables of the means over the pairs of each split, one per condition.
    """
    content = {"settings": settings, "rows": rows}
    text = json.dumps(content, indent=1, ensure_ascii=False) + "\n"
    write_text(folder / "results.json", text)
    rows = with_splits(rows)
    write_text(folder / "pairs.csv", csv_text(list(rows[0]), rows))
    shown = ", ".join(f"{k} {v}" for k, v in settings.items() if k != "data")
    visible = dict.fromkeys(f"{_VISIBLE[row['visible_by']]}\n" for row in rows)
    means, pairs = [], []
    for condition, title in _CONDITIONS.items():
        if some := [row for row in rows if row["condition"] == condition]:
            of_paper = published if condition == AS_GIVEN else {}
            header = ("split", "metric", *_representations(some))
            cells = list(_mean_rows(some, _paper() if of_paper else {}))
            means.append(Table(title, header, cells, text_columns=(0, 1)))
            pairs.append(_per_pair(title, some, of_paper))
    tables = [table.markdown() for table in (*means, *pairs)]
    head = f"# Keypoints\n\nSettings: {markdown_text(shown)}.\n"
    write_text(folder / "keypoints.md", "\n".join([head, *visible, *tables]))
    return means


def _representations(rows: Sequence[Row]) -> list[str]:
    return list(dict.fromkeys(row["representation"] for row in rows))


def _mean_rows(
    rows: Sequence[Row], paper: Mapping[tuple[str, str], Any]
) -> Iterator[Sequence[str]]:
    """Yield means over the pairs with a defined score, and the paper's means below them."""
    splits, representations = {row["split"] for row in rows}, _representations(rows)
    for split in sorted(splits, key=lambda name: (name != "hard", name != "easy")):
        columns = [
            [row for row in rows if (row["split"], row["representation"]) == (split, name)]
            for name in representations
        ]
        title = f"{split or 'all'} ({max(map(len, columns))})"
        for metric, key in _METRICS.items():
            known = [[row[key] for row in some if row[key] is not None] for some in columns]
            if not any(known) and key not in _SCORES:
                continue
            average = np.median if metric.endswith("median") else np.mean
            means = (float(average(values)) if values else None for values in known)
            yield (title, metric, *(_text(mean, metric) for mean in means))
            title = ""
            if printed := paper.get((split, key)):
                figures = (printed.get(name) for name in representations)
                texts = (_text(float(figure) if figure else None, metric) for figure in figures)
                yield ("", f"{metric}, paper", *texts)


def _per_pair(title: str, rows: Sequence[Row], published: Mapping[str, PublishedPair]) -> Table:
    cells: list[Sequence[str]] = []
    representations = _representations(rows)
    for name in dict.fromkeys(row["pair"] for row in rows):
        found = {row["representation"]: row for row in rows if row["pair"] == name}
        scores = (_triple([found[n][key] for key in _SCORES]) for n in representations)
        first = found[representations[0]]
        cells.append((name, first["split"] or "–", percent(first["fov_overlap"]), *scores))
        if printed := published.get(name):
            scores = (_triple(printed.scores.get(n, (None,) * 3)) for n in representations)
            cells.append(("paper", "", percent(printed.fov_overlap), *scores))
    header = ("pair", "split", "overlap %", *representations)
    note = "PMR / MS / P in percent."
    return Table(f"Per pair: {title.lower()}", header, cells, note, text_columns=(0, 1))


def with_splits(rows: Sequence[Row]) -> list[Row]:
    """Split pairs into two halves by overlap, as in the paper, unless they have splits.

    Args:
        rows: Rows of all pairs.

    Returns:
        Rows with splits: the half with smaller overlaps is ``hard``, the other, which may have one
        more pair, ``easy``. Rows are unchanged if an overlap is unknown or all are equal.
    """
    overlaps = {row["pair"]: row["fov_overlap"] for row in rows}
    has_splits = any(row["split"] for row in rows)
    if has_splits or None in overlaps.values() or len(set(overlaps.values())) < 2:
        return list(rows)
    ordered = sorted(overlaps, key=lambda name: overlaps[name])
    hard = set(ordered[: len(ordered) // 2])
    return [{**row, "split": "hard" if row["pair"] in hard else "easy"} for row in rows]


def _paper() -> dict[tuple[str, str], dict[str, str]]:
    """Read the tables of the paper by split and score."""
    text = Path(__file__).with_name("paper.csv").read_text(encoding="utf-8")
    return {(row["split"], row["figure"]): row for row in csv.DictReader(text.splitlines())}


def _text(value: float | None, metric: str) -> str:
    if metric.endswith("%") or value is None:
        return percent(value)
    return f"{value:,.0f}" if value >= 100 else f"{value:.3g}"


def _triple(scores: Sequence[float | None]) -> str:
    return "–" if all(s is None for s in scores) else " / ".join(map(percent, scores))


def matches_png(comparison: Comparison, condition: str) -> bytes:
    """Draw the matches of one pair, with a panel for each representation.

    The left panorama is above the right one. Up to 150 inliers are lines, colored by longitude in
    the left panorama, along the shorter way around the sphere; other matches are red dots.

    Args:
        comparison: Compared pair.
        condition: Condition of the comparison to draw.

    Returns:
        Content of a PNG file.
    """
    left, right = comparison.images[condition]
    (rows, width), found = left.shape[:2], comparison.matched[condition]
    figure = Figure((8 * len(found), 8), layout="constrained")
    panels = figure.subplots(1, len(found), squeeze=False)[0]
    for axes, (name, one) in zip(panels, found.items(), strict=True):
        axes.imshow(left, extent=(-0.5, width - 0.5, rows - 0.5, -0.5), alpha=0.6)
        axes.imshow(right, extent=(-0.5, width - 0.5, 2 * rows - 0.5, rows - 0.5), alpha=0.6)
        starts = one.left.equirect_pixels((rows, width))[one.matches[:, 0]]
        ends = one.right.equirect_pixels((rows, width))[one.matches[:, 1]] + np.array([0, rows])
        inliers = one.geometry.inliers
        for dots in (starts[~inliers], ends[~inliers]):
            axes.plot(*dots.T, ".", color="darkred", markersize=3)
        shown = np.random.default_rng(0).permutation(np.flatnonzero(inliers))[:_MOST_LINES]
        lines = np.stack([starts[shown], ends[shown]], axis=1)
        lines[:, 1, 0] += width * np.rint((lines[:, 0, 0] - lines[:, 1, 0]) / width)
        for shift in (-width, 0, width):  # lines across the seam appear on both sides
            moved = lines + np.array([shift, 0])
            axes.add_collection(
                LineCollection(list(moved), array=starts[shown, 0], cmap="hsv", clim=(0, width))
            )
        axes.set(xlim=(-0.5, width - 0.5), ylim=(2 * rows - 0.5, -0.5), xticks=[], yticks=[])
        axes.set_title(f"{name}: {len(inliers)} matches, {int(inliers.sum())} inliers")
    file = io.BytesIO()
    figure.savefig(file, format="png")
    return file.getvalue()
