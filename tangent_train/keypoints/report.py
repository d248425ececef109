"""Write the scores of keypoints as the paper's tables, and draw matches."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from datamodules.core.panorama_pairs import PublishedPair
from tangent_train.files import csv_text, write_text
from tangent_train.keypoints.compare import AS_GIVEN, AUC_DEG, ROTATED, Comparison, Row
from tangent_train.results.tables import Table, percent

_CONDITIONS = {AS_GIVEN: "As they are", ROTATED: "Right panorama randomly rotated"}
_SCORES = {"PMR %": "pmr", "MS %": "ms", "P %": "p"}
_METRICS = {
    **_SCORES,
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


@dataclass(frozen=True)
class KeypointReport:
    """All tables over the pairs of one data set.

    Attributes:
        rows: Rows of `Comparer.compare` for all pairs.
        representations: Representations in the order of the columns.
        settings: Settings that affect the scores.
        published: The paper's pairs by name; empty for other data.
    """

    rows: Sequence[Row]
    representations: Sequence[str]
    settings: Mapping[str, Any]
    published: Mapping[str, PublishedPair]

    def write(self, folder: Path) -> None:
        """Write ``results.json``, ``pairs.csv`` and ``keypoints.md``."""
        rows = with_splits(self.rows)
        write_text(folder / "pairs.csv", csv_text(list(rows[0]), rows))
        write_text(folder / "keypoints.md", self.markdown())
        content = {"settings": self.settings, "rows": self.rows}
        write_text(
            folder / "results.json", json.dumps(content, indent=1, ensure_ascii=False) + "\n"
        )

    def markdown(self) -> str:
        """Return all tables as Markdown."""
        settings = ", ".join(f"{k} {v}" for k, v in self.settings.items() if k != "data")
        visible = dict.fromkeys(f"{_VISIBLE[row['visible_by']]}\n" for row in self.rows)
        head = [f"# Keypoints\n\nSettings: {settings}.\n", *visible]
        tables = [*self.means(), *map(self._per_pair, self._conditions())]
        return "\n".join([*head, *(table.markdown() for table in tables)])

    def means(self) -> list[Table]:
        """Return the means over the pairs of each split, one table per condition."""
        header = ("split", "metric", *self.representations)
        return [
            Table(_CONDITIONS[c], header, list(self._mean_rows(c)), text_columns=(0, 1))
            for c in self._conditions()
        ]

    def _conditions(self) -> list[str]:
        return [c for c in _CONDITIONS if any(row["condition"] == c for row in self.rows)]

    def _groups(self, condition: str, key: str) -> dict[Any, list[list[Row]]]:
        """Return the rows of a condition by split or pair, and by representation."""
        groups: dict[Any, list[list[Row]]] = {}
        for row in with_splits(self.rows):
            if row["condition"] == condition:
                columns = groups.setdefault(row[key], [[] for _ in self.representations])
                columns[self.representations.index(row["representation"])].append(row)
        return groups

    def _mean_rows(self, condition: str) -> Iterator[Sequence[str]]:
        """Yield means over the pairs with a defined score, and the paper's means below them."""
        groups = self._groups(condition, "split")
        for split in sorted(groups, key=lambda name: (name != "hard", name != "easy")):
            printed = _paper().get(split, {}) if self.published and condition == AS_GIVEN else {}
            title = f"{split or 'all'} ({max(map(len, groups[split]))})"
            for metric, key in _METRICS.items():
                known = [[r[key] for r in rows if r[key] is not None] for rows in groups[split]]
                if not any(known) and key not in _SCORES.values():
                    continue
                average = np.median if metric.endswith("median") else np.mean
                means = (float(average(values)) if values else None for values in known)
                yield (title, metric, *(_text(mean, metric) for mean in means))
                title = ""
                if key in printed:
                    figures = (printed[key].get(name) for name in self.representations)
                    paper = (_text(float(figure) if figure else None, metric) for figure in figures)
                    yield ("", f"{metric}, paper", *paper)

    def _per_pair(self, condition: str) -> Table:
        header = ("pair", "split", "overlap %", *self.representations)
        cells: list[Sequence[str]] = []
        for name, columns in self._groups(condition, "pair").items():
            rows = [row for (row,) in columns]
            scores = (_triple([row[key] for key in _SCORES.values()]) for row in rows)
            one = rows[0]
            cells.append((name, one["split"] or "–", percent(one["fov_overlap"]), *scores))
            printed = self.published.get(name)
            if printed is not None and condition == AS_GIVEN:
                scores = (_triple(printed.scores.get(n, (None,) * 3)) for n in self.representations)
                cells.append(("paper", "", percent(printed.fov_overlap), *scores))
        title = f"Per pair: {_CONDITIONS[condition].lower()}"
        return Table(title, header, cells, note="PMR / MS / P in percent.", text_columns=(0, 1))


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


def _paper() -> dict[str, dict[str, dict[str, str]]]:
    """Read the tables of the paper by split, score and representation."""
    text = Path(__file__).with_name("paper.csv").read_text(encoding="utf-8")
    tables: dict[str, dict[str, dict[str, str]]] = {}
    for row in csv.DictReader(text.splitlines()):
        tables.setdefault(row["split"], {})[row["figure"]] = row
    return tables


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
    from matplotlib.collections import LineCollection
    from matplotlib.figure import Figure

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
