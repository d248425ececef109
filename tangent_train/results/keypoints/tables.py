"""``keypoints.md`` and ``pairs.csv``: the paper's two tables, overall and per pair."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from tangent_train.csv_text import csv_text
from tangent_train.results.keypoints.entries import AS_GIVEN, TURNED, PairEntry, Scored, with_splits
from tangent_train.results.keypoints.means import (
    PAPER,
    PAPER_STATISTICS,
    SCORES,
    SplitMeans,
    splits_of,
)
from tangent_train.results.keypoints.representations import SHRUNK
from tangent_train.results.tables import Table as CellTable
from tangent_train.results.tables import percent

if TYPE_CHECKING:
    from rich.table import Table

    from datamodules.stanford2d3ds.pairs import PublishedPair

__all__ = ["KeypointReport", "overall_cells", "overall_tables", "pairs_csv", "shown_name"]

Cells = tuple[str, ...]
"""A row of a table."""

_PAPER_REPRESENTATIONS = ("ERP", "L0", "L1", "L2")
_CONDITIONS = {
    AS_GIVEN: "As they are",
    TURNED: "Right panorama turned by a random rotation",
}
_SHOWN = {SHRUNK: "ERP ×0.71"}
_EXTRA: dict[str, Callable[[Scored], float | None]] = {
    "right matches %": lambda scored: scored.correct_share,
    "keypoints": lambda scored: (scored.keypoints_left + scored.keypoints_right) / 2,
    "inliers": lambda scored: scored.inliers,
}
_ERRORS: dict[str, Callable[[Scored], float | None]] = {
    "rotation error °, median": lambda scored: scored.rotation_error_deg,
    "translation error °, median": lambda scored: scored.translation_error_deg,
}
_COLUMNS = (
    "pair",
    "split",
    "left",
    "right",
    "level",
    "fov_overlap",
    "fov_overlap_paper",
    "visible_by",
    "condition",
    "representation",
    "keypoints_left",
    "keypoints_right",
    "visible_left",
    "visible_right",
    "putative",
    "inliers",
    *SCORES,
    *(f"{name}_paper" for name in SCORES),
    "geometry",
    "rotation_error_deg",
    "translation_error_deg",
    "judged",
    "correct",
)


@dataclass(frozen=True)
class KeypointReport:
    """All tables over the pairs of one data set.

    Attributes:
        entries: Of all pairs, see `with_splits`.
        representations: In the order of the columns.
        published: The paper's pairs by name, where the data are those; else empty.
        settings: What the figures were made with, to be told.
    """

    entries: tuple[PairEntry, ...]
    representations: tuple[str, ...]
    published: Mapping[str, PublishedPair]
    settings: str = ""

    @property
    def conditions(self) -> list[str]:
        """The conditions that there are figures of."""
        there = {scored.condition for entry in self.entries for scored in entry.scored}
        return [condition for condition in _CONDITIONS if condition in there]

    def markdown(self) -> str:
        """All tables."""
        return "\n".join(
            [
                *self._head(),
                *self._overall(),
                *self._per_pair(),
                *self._without_keypoints(),
                *self._failed(),
            ]
        )

    def _head(self) -> Iterator[str]:
        yield from ("# Keypoints", "", f"{self.settings}", "", _visibility(self.entries), "")
        used = with_splits(self.entries)
        if not any(split.split for split in splits_of(used)):
            return
        rows: list[Cells] = [
            ("split", "pairs", "overlap of the fields of view %", "inliers on ERP")
        ]
        for split in splits_of(used):
            inliers = split.mean(AS_GIVEN, "ERP", lambda scored: scored.inliers)
            rows.append(
                (
                    split.split or "–",
                    str(len(split.entries)),
                    percent(split.fov_overlap),
                    _number(inliers),
                )
            )
            if self.published and split.split in PAPER_STATISTICS:
                pairs, overlap, count = PAPER_STATISTICS[split.split]
                rows.append(("paper", str(pairs), f"{100 * overlap:.2f}", str(count)))
        yield from (*_markdown(rows, 1), "")

    def _overall(self) -> Iterator[str]:
        for condition in self.conditions:
            yield from (f"## {_CONDITIONS[condition]}", "")
            yield from (*_markdown(overall_cells(self, condition), 2), "")

    def _per_pair(self) -> Iterator[str]:
        for condition in self.conditions:
            title = _CONDITIONS[condition]
            yield from (f"## Per pair: {title[0].lower()}{title[1:]}", "")
            yield "PMR / MS / P in percent, – where a figure is not defined."
            yield from ("", *_markdown(self._pair_rows(condition), 2), "")

    def _pair_rows(self, condition: str) -> list[Cells]:
        rows: list[Cells] = [("pair", "split", "overlap %", *map(shown_name, self.representations))]
        for entry in with_splits(self.entries):
            found = entry.of_condition(condition)
            triples = (_triple(found.get(name)) for name in self.representations)
            rows.append((entry.name, entry.split or "–", percent(entry.fov_overlap), *triples))
            published = self.published.get(entry.name)
            if published is not None and condition == AS_GIVEN:
                printed = (
                    " / ".join(f"{100 * v:.0f}" for v in published.scores[name])
                    if name in published.scores
                    else "–"
                    for name in self.representations
                )
                rows.append(("paper", "", f"{100 * published.fov_overlap:.0f}", *printed))
        return rows

    def _without_keypoints(self) -> Iterator[str]:
        names = dict.fromkeys(name for entry in self.entries for name in entry.without_keypoints)
        if names:
            yield from ("## Panoramas without any keypoint", "")
            yield from (*(f"* {name}" for name in names), "")

    def _failed(self) -> Iterator[str]:
        failed = [entry for entry in self.entries if entry.error is not None]
        if failed:
            yield from ("## Pairs that could not be used", "")
            rows: list[Cells] = [("pair", "why"), *((e.name, str(e.error)) for e in failed)]
            yield from (*_markdown(rows, 2), "")


def overall_cells(report: KeypointReport, condition: str) -> list[Cells]:
    """Means over the pairs of each split, header first; the best of each score in bold.

    Args:
        report: The report.
        condition: `AS_GIVEN` or `TURNED`; the paper's figures stand beside the former.
    """
    rows: list[Cells] = [("split", "metric", *map(shown_name, report.representations))]
    for split in splits_of(with_splits(report.entries)):
        name = f"{split.split or 'all'} ({len(split.entries)})"
        for score in SCORES:
            means = [
                split.mean(condition, r, lambda scored: getattr(scored, score))  # noqa: B023
                for r in report.representations
            ]
            rows.append((name, f"{score.upper()} %", *_with_best(means)))
            if report.published and condition == AS_GIVEN and split.split in PAPER:
                rows.append(
                    ("", f"{score.upper()} %, paper", *_printed(report, split.split, score))
                )
            name = ""
        rows += _further_rows(report, condition, split)
    return rows


def _further_rows(report: KeypointReport, condition: str, split: SplitMeans) -> Iterator[Cells]:
    for name, figure in _EXTRA.items():
        means = [split.mean(condition, r, figure) for r in report.representations]
        if any(mean is not None for mean in means):
            yield ("", name, *(percent(m) if "%" in name else _number(m) for m in means))
    for name, figure in _ERRORS.items():
        medians = [split.median(condition, r, figure) for r in report.representations]
        if any(median is not None for median in medians):
            yield ("", name, *(_number(median, 2) for median in medians))


def _printed(report: KeypointReport, split: str, score: str) -> Iterator[str]:
    printed = dict(zip(_PAPER_REPRESENTATIONS, PAPER[split][score], strict=True))
    return (percent(printed.get(name)) for name in report.representations)


def _with_best(means: Sequence[float | None]) -> Iterator[str]:
    best = max((percent(m) for m in means if m is not None), key=float, default="")
    texts = [percent(mean) for mean in means]
    return (f"**{text}**" if text == best and len(texts) > 1 else text for text in texts)


def _visibility(entries: Sequence[PairEntry]) -> str:
    known = {entry.has_geometry for entry in entries if entry.error is None}
    seen = (
        "n_L and n_R are the keypoints visible to the other panorama, by depth and pose, occlusion "
        "heeded."
    )
    every = (
        "n_L and n_R are all keypoints, as depth and pose are not known: PMR and MS are smaller "
        "than they would be among the visible ones."
    )
    if known == {True, False}:
        return f"Where depth and pose are known, {seen[0].lower()}{seen[1:]} Elsewhere {every}"
    return every if known == {False} else seen


def shown_name(representation: str) -> str:
    """A representation as tables call it."""
    return _SHOWN.get(representation, representation)


def _triple(scored: Scored | None) -> str:
    if scored is None:
        return "–"
    return " / ".join(percent(getattr(scored, name)) for name in SCORES)


def _number(value: float | None, digits: int = 0) -> str:
    return "–" if value is None else f"{value:.{digits}f}"


def overall_tables(report: KeypointReport) -> list[Table]:
    """The tables of means for the terminal."""
    return [
        _terminal(
            _CONDITIONS[condition],
            [
                tuple(text.replace("**", "") for text in row)
                for row in overall_cells(report, condition)
            ],
            (0, 1),
        )
        for condition in report.conditions
    ]


def pairs_csv(entries: Sequence[PairEntry], published: Mapping[str, PublishedPair]) -> str:
    """A line per pair, condition and representation; shares of 1, empty where not defined.

    Args:
        entries: Of all pairs; those that could not be used are left out.
        published: See `KeypointReport`.
    """
    rows = []
    for entry in with_splits(entries):
        paper = published.get(entry.name)
        for scored in entry.scored:
            printed = paper.scores.get(scored.representation) if paper else None
            printed = printed if scored.condition == AS_GIVEN else None
            rows.append(
                {
                    **vars(entry),
                    **vars(scored),
                    "pair": entry.name,
                    "visible_by": "depth" if entry.has_geometry else "all keypoints",
                    "fov_overlap_paper": paper.fov_overlap if paper else None,
                    "geometry": scored.kind,
                    **dict(
                        zip((f"{n}_paper" for n in SCORES), printed or (None,) * 3, strict=True)
                    ),
                }
            )
    return csv_text(_COLUMNS, rows)


def _markdown(rows: Sequence[Cells], left: int) -> list[str]:
    table = CellTable("", rows[0], rows[1:], text_columns=range(left))
    return table.markdown().splitlines()


def _terminal(title: str, rows: Sequence[Cells], left: Sequence[int]) -> Table:
    return CellTable(title, rows[0], rows[1:], text_columns=left).terminal()
