"""Report several evaluations: rows of scores as tables, files and a chart."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

from tangent_train.console import print_text
from tangent_train.files import csv_text, write_bytes, write_text
from tangent_train.metrics.scores import SOLID_ANGLE
from tangent_train.results.chart import report_png
from tangent_train.results.evaluation import EvaluationResult
from tangent_train.results.paired import Difference, difference
from tangent_train.results.published import published_rows
from tangent_train.results.rows import Part, RunRow, check_alike, group_results
from tangent_train.results.tables import Table, markdown_text, score_text

Cell = tuple[str, str]
"""View and condition: row and column in the first table."""

_LEGEND = (
    "Mean over folds of the mean over seeds; ± the sample standard deviation over folds, "
    "in brackets that over seeds within a fold."
)
_LEGEND_OF_INTERVALS = "[…] of a single run: 95 % bootstrap interval over its images."
_LEGEND_OF_DIFFERENCES = (
    "Percentages differ in points. […]: 95 % bootstrap interval; each draw has the same images in "
    "both runs."
)
_CHANGE = "over the folds and seeds that both have."
_REPRESENTATIONS = {
    "Cubemap": "cube map",
    "Equirect": "ERP",
    "Perspective": "photos",
    "Tangent": "tangent images",
}


@dataclass(frozen=True)
class Report:
    """Rows of the same scores over the same classes.

    Attributes:
        title: Title of the report.
        rows: Evaluations, and published scores.
        notes: Sentences about the rows.
        compared: Explanation of the column "change"; empty without this column.
        cells: Cell of a row in a table of views and conditions, by the row's label. The table is
            written only if there are several conditions.
        label: Returns the label of a row in the chart.
        base: Label of the row from which others differ, see `RunRow.difference`.
    """

    title: str
    rows: Sequence[RunRow]
    notes: Sequence[str] = ()
    compared: str = ""
    cells: Mapping[str, Cell] = field(default_factory=dict)
    label: Callable[[str], str] = str
    base: str = ""

    @property
    def first(self) -> EvaluationResult:
        """First evaluation; all have the same scores and classes."""
        return next(result for row in self.rows for result in row.results)

    @property
    def _legend(self) -> str:
        in_percent = all(column.unit == "%" for column in self.first.columns.values())
        return "Percent. " * in_percent + _LEGEND

    def tables(self) -> list[Table]:
        """Return the tables of views, means, differences, the sphere, classes and latitudes."""
        first, tables = self.first, [self._views(), self.means()]
        tables += [self.differences(), self.sphere()]
        for name, mean in first.class_means.items():
            if not name.endswith(SOLID_ANGLE):
                title = first.columns[mean].class_title
                parts: dict[str, tuple[str, Part]] = {c: (name, c) for c in first.class_names}
                tables.append(self._parts(title[:1].upper() + title[1:], parts))
        bands = next((row.bands for row in self.rows if row.bands), [])
        parts = {f"{band[0]:g}° … {band[1]:g}°": (first.main, band) for band in bands}
        tables.append(self._parts(f"{first.columns[first.main].title} by latitude", parts))
        return [table for table in tables if table.rows]

    def _views(self) -> Table:
        """Return the main score of the views in conditions; no rows with a single condition."""
        by_angle = self.first.main + SOLID_ANGLE
        name = by_angle if by_angle in self.first.columns else self.first.main
        rows = {row.label: row for row in self.rows}
        scores = {cell: self._cell(rows[label], name) for label, cell in self.cells.items()}
        views, conditions = (dict.fromkeys(cell[k] for cell in scores) for k in (0, 1))
        cells = [(view, *(scores.get((view, c), "–") for c in conditions)) for view in views]
        title = f"{self.title}: {self.first.columns[name].title}"
        note = f"{self._legend} {_LEGEND_OF_INTERVALS}"
        return Table(title, ("", *conditions), cells if len(conditions) > 1 else [], note)

    def _parts(self, title: str, parts: Mapping[str, tuple[str, Part]]) -> Table:
        """Return the table of scores of all images, classes or latitude bands, given by title."""
        rows = [
            (row.label, *(self._cell(row, *part) for part in parts.values()))
            for row in self.rows
            if any(row.score(*part).folds for part in parts.values())
        ]
        return Table(title, ("", *parts), rows)

    def means(self) -> Table:
        """Return the table of the scores over all images."""
        scores, rows = self.first.main_columns, self.rows
        names = dict.fromkeys(name for row in rows for name in row.facts)
        facts = {name: [row.facts.get(name, "–") for row in rows] for name in names}
        alike = [f"{name} {cells[0]}" for name, cells in facts.items() if len(set(cells)) == 1]
        columns = [("", [row.label for row in rows])]
        columns += [(name, cells) for name, cells in facts.items() if len(set(cells)) > 1]
        texts = range(len(columns))
        for name, column in scores.items():
            columns.append((column.title, [self._cell(row, name) for row in rows]))
            if self.compared and not name.endswith(SOLID_ANGLE):
                columns.append(("change", [_change(row.ratio(name)) for row in rows]))
        header, cells_of = zip(*columns, strict=True)
        has_intervals = any(row.score(name).interval for row in rows for name in scores)
        common = f"{'; '.join(alike)}." if alike else ""
        notes = (common, self._legend, _LEGEND_OF_INTERVALS * has_intervals, self.compared)
        cells = list(zip(*cells_of, strict=True))
        return Table(self.title, header, cells, " ".join(filter(None, notes)), texts)

    def differences(self) -> Table:
        """Return the table of the differences from the first run; no rows without differences."""
        found = {row.label: row.difference for row in self.rows if row.difference is not None}
        rows = [(f"{self.first.noun} of both", *(str(of.images) for of in found.values()))]
        for name, column in self.first.columns.items():
            is_shown = column.is_main or column.of_sphere
            if is_shown and any(name in of.scores for of in found.values()):
                cells = (_signed(of, name, column.unit) for of in found.values())
                rows.append((column.title, *cells))
        title = f"Difference from {self.base}"
        return Table(title, ("", *found), rows if found else [], _LEGEND_OF_DIFFERENCES)

    def sphere(self) -> Table:
        """Return the table of the scores that only panoramas have, in the first condition."""
        first = next(iter(self.cells.values()), ("", ""))
        rows = [row for row in self.rows if self.cells.get(row.label, first)[1] == first[1]]
        columns = {name: c for name, c in self.first.columns.items() if c.of_sphere}
        scored = [name for name in columns if any(row.score(name).folds for row in rows)]
        parts = {columns[name].title: (name, None) for name in scored}
        return replace(self, rows=rows)._parts(f"On the sphere {first[1]}".strip(), parts)

    def print(self) -> None:
        """Print the first table, differences, the table of the sphere, and the notes."""
        for table in (self.tables()[0], self.differences(), self.sphere()):
            if table.rows:
                table.print()
        for note in self.notes:
            print_text(f"- {note}")

    def _cell(self, row: RunRow, name: str, part: Part = None) -> str:
        """Return a score with its spreads, and "of 2" if it is over fewer folds than the row."""
        score = row.score(name, part)
        column = self.first.columns[self.first.class_means.get(name, name)]
        text = partial(score_text, unit=column.unit)
        over_folds = "" if score.over_folds is None else f" ± {text(score.over_folds)}"
        over_seeds = "" if score.over_seeds is None else f" (± {text(score.over_seeds)})"
        count = f" of {score.folds}" if 0 < score.folds < len(row.folds) else ""
        return text(score.mean, interval=score.interval) + over_folds + over_seeds + count

    def write(self, folder: Path, name: str) -> None:
        """Write the report as ``.md``, ``.csv`` and ``.png``, each atomically.

        Args:
            folder: Output folder.
            name: Name of the files.
        """
        write_text(folder / f"{name}.md", self._markdown())
        lines = list(self.csv_lines())
        titles = list(dict.fromkeys(title for line in lines for title in line))
        write_text(folder / f"{name}.csv", csv_text(titles, lines))
        rows = [replace(row, label=self.label(row.label)) for row in self.rows]
        write_bytes(folder / f"{name}.png", report_png(self.title, rows, self.first))

    def csv_lines(self) -> Iterator[dict[str, Any]]:
        """Yield a line for each row, fold ("mean" over all folds), class or band, and score."""
        for row in self.rows:
            for fold in dict.fromkeys((*row.folds, None)):
                for name, part in row.scores:
                    south, north = part if isinstance(part, tuple) else (None, None)
                    score = row.score(name, part, fold)._asdict()
                    low, high = score.pop("interval") or (None, None)
                    found = row.difference if fold is None and part is None else None
                    ends = found.intervals.get(name) if found else None
                    yield {
                        "row": row.label,
                        **row.facts,
                        "fold": "mean" if fold is None else fold,
                        "class": part if isinstance(part, str) else "mean",
                        "south": south,
                        "north": north,
                        "score": name,
                        **score,
                        "low": low,
                        "high": high,
                        "ratio": row.ratio(name, part, fold),
                        "difference": found and found.scores.get(name),
                        "difference_low": ends and ends[0],
                        "difference_high": ends and ends[1],
                        "difference_images": found and found.images,
                    }

    def _markdown(self) -> str:
        first, *others = (table.markdown() for table in self.tables())
        notes = "".join(f"- {markdown_text(note)}\n" for note in self.notes)
        runs = [
            (row.label, str(r.fold or "–"), str(r.seed), str(r.folder))
            for row in self.rows
            for r in row.results
        ]
        table = Table("Runs", ("", "fold", "seed", "run"), runs, text_columns=(0, 3))
        return "\n".join([f"# {first[3:]}", notes, *others, table.markdown()])


def _change(ratio: float | None) -> str:
    """Return the ratio to another score as a relative change in percent.

    >>> _change(0.955), _change(1.026), _change(0.9999)
    ('−4.5 %', '+2.6 %', '+0.0 %')
    """
    if ratio is None:
        return "–"
    rounded = round(100 * (ratio - 1), 1) + 0.0  # no −0.0
    return f"{rounded:+.1f} %".replace("-", "−")


def _signed(found: Difference, name: str, unit: str) -> str:
    """Return a difference with its sign and its interval."""
    score, interval = found.scores.get(name), found.intervals.get(name)
    return "+" * (score is not None and score > 0) + score_text(score, unit, interval)


def runs_report(results: Sequence[EvaluationResult], notes: Sequence[str] = ()) -> Report:
    """Report the mean and spread of each group of finished runs, with published scores.

    Rows of a single run have differences from the first row, if that is of a single run too.

    Args:
        results: Results of the runs.
        notes: Notes to add.

    Raises:
        DataError: The runs have different scores or classes.
    """
    protocols = [result.protocol for result in results]
    shown = [
        name
        for name in dict.fromkeys(name for protocol in protocols for name in protocol)
        if name not in ("data", "classes") and len({p.get(name) for p in protocols}) > 1
    ]
    rows, sources = _rows(group_results(results), shown)
    base, missing = rows[0], []
    for place, row in enumerate(rows[1:], start=1):
        if len(row.results) == len(base.results) == 1:
            found = difference(row.results[0], base.results[0])
            if isinstance(found, Difference):
                rows[place] = replace(row, difference=found)
            else:
                missing.append(f"{row.label}: no difference from {base.label}: {found}.")
    rows.sort(
        key=lambda row: (
            row.facts["data"],
            row.facts["s"].zfill(2),
            not row.label.endswith("(paper)"),
        )
    )
    return Report("Report", rows, [*sources, *missing, *notes], base=base.label)


def transfer_report(
    stages: Mapping[str, Sequence[EvaluationResult]], cells: Mapping[str, Cell] | None = None
) -> Report:
    """Report a transfer from photos to panoramas, with published scores.

    Args:
        stages: Evaluations by the names of their stages. S, S-erp and S-FT-10, tested on panoramas,
            are compared with P and P-FT-10, tested on photos, after the same fine-tuning.
        cells: View and condition of stages that evaluate the same network.
    """
    rows, notes = _rows(stages, ["test_rotation"], transfer=True)
    by_name = {row.label: row for row in rows}
    rows = [replace(row, partner=by_name.get(_photos_of(name))) for name, row in by_name.items()]
    compared = f"Change: from photos after the same fine-tuning, {_CHANGE}"
    compared *= any(row.partner for row in rows)
    return Report("Transfer from photos to panoramas", rows, notes, compared, cells or {}, in_words)


def in_words(stage: str) -> str:
    """Return the data of a stage's test, the views or condition, and the fine-tuning.

    >>> in_words("S-FT-10 (paper)"), in_words("S-erp"), in_words("P")
    ('panoramas, epochs of fine-tuning: 10 (paper)', 'panoramas, erp', 'photos')
    """
    parts = {"P": "photos", "S": "panoramas", "FT": "epochs of fine-tuning:"}
    return ", ".join(parts.get(part, part) for part in stage.split("-")).replace(":,", ":")


def _photos_of(stage: str) -> str:
    """Return the stage on photos with the same fine-tuning; "" for a stage on photos.

    >>> _photos_of("S-FT-10 (paper)"), _photos_of("S-erp"), _photos_of("P")
    ('P-FT-10 (paper)', 'P', '')
    """
    name, mark, paper = stage.partition(" (paper)")
    if name[0] != "S":
        return ""
    photos = f"P{name[1:]}" if "-FT-" in name else "P"
    return photos + mark + paper


def levels_report(levels: Mapping[int, Sequence[EvaluationResult]], trained_level: float) -> Report:
    """Report one network at several levels of the panoramas.

    This is the paper's third transfer experiment: photos are normalized to the angular resolution
    of one level; scores decrease with the difference from the resolution of the panoramas.

    Args:
        levels: Evaluations by level.
        trained_level: Level with the angular resolution of the photos in training; a fraction if it
            is between two levels.
    """
    ordered = sorted(levels)
    nearest = min(ordered, key=lambda level: abs(level - trained_level))
    rows, notes = _rows({f"level {level}": levels[level] for level in ordered}, published=False)
    partner = rows[ordered.index(nearest)]
    rows = [row if row is partner else replace(row, partner=partner) for row in rows]
    notes.append(f"Photos in training: the angular resolution of level {trained_level:g}.")
    change = f"Change: from level {nearest}, {_CHANGE}"
    return Report("One network at several levels", rows, notes, change)


def _rows(
    groups: Mapping[str, Sequence[EvaluationResult]],
    shown: Sequence[str] = (),
    *,
    published: bool = True,
    transfer: bool = False,
) -> tuple[list[RunRow], list[str]]:
    """Return a row for each group, then published scores; and notes on missing folds and sources.

    Args:
        groups: Evaluations by label of the row.
        shown: Facts of the protocols that are columns of the tables.
        published: True for published scores too.
        transfer: See `published_rows`.

    Raises:
        DataError: The evaluations have different scores or classes.
    """
    results = [result for group in groups.values() for result in group]
    check_alike(results)
    rows = [RunRow.of(label, some, _facts(some, shown)) for label, some in groups.items()]
    notes = []
    for row in rows:
        folds = row.results[0].folds
        if missing := [str(fold) for fold in folds if fold not in row.folds]:
            text = f"fold {' and '.join(missing)} missing; not a mean of {len(folds)} folds."
            notes.append(f"{row.label}: {text}")
    if published:
        others, sources = published_rows(results, transfer=transfer, shown=shown)
        rows, notes = rows + others, notes + sources
    return rows, notes


def _facts(results: Sequence[EvaluationResult], shown: Sequence[str]) -> dict[str, str]:
    """Return data, inputs and views of a row, by column."""
    result, settings = results[0], results[0].settings
    folds = sorted({str(r.fold) for r in results if r.fold is not None})
    inputs = settings.get("data.inputs")
    further = [name for name in inputs or () if name not in ("rgb", "depth")]
    colors = "RGB-D" if "depth" in (inputs or ()) else "RGB"
    return {
        "data": str(settings.get("data._target_")).rpartition(".")[2],
        "s": str(settings.get("level") or "–"),
        "input": "–" if inputs is None else " + ".join([colors, *further]),
        "b": _base_level(settings),
        **{name: result.protocol.get(name, "–") for name in shown},
        **({} if result.label_map is None else {"label map": result.label_map}),
        "folds": ", ".join(folds) or "–",
        "runs": str(len(results)),
    }


def _base_level(settings: Mapping[str, Any]) -> str:
    """Return the base level b of tangent images, or a short name of another representation."""
    base = settings.get("representation.base_level")
    if base is not None:
        return str(base)
    target = str(settings.get("representation._target_")).rpartition(".")[2]
    name = target.removesuffix("Representation")
    aware = ", distortion-aware" * bool(settings.get("representation.distortion_aware"))
    return _REPRESENTATIONS.get(name, name) + aware
