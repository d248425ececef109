"""Report several evaluations: rows of scores as tables, files and a chart."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from datamodules.stanford2d3ds.files import FOLDS
from tangent_train.files import csv_text, write_bytes, write_text
from tangent_train.metrics.score_columns import SOLID_ANGLE
from tangent_train.results.chart import grid_png, report_png
from tangent_train.results.evaluation_result import Band, EvaluationResult
from tangent_train.results.rows import Row
from tangent_train.results.tables import Table, score_text

Cell = tuple[str, str]
"""View and condition: row and column in the first table."""

_LEGEND = (
    "Mean over folds of the mean over seeds; ± the sample standard deviation over folds, "
    "in brackets that over seeds within a fold."
)
_LEGEND_OF_INTERVALS = "[…] of a single run: 95 % bootstrap interval over its images."


@dataclass(frozen=True)
class Report:
    """Rows of the same scores over the same classes.

    Attributes:
        title: Title of the report.
        rows: Evaluations, and published scores.
        notes: Sentences about the rows.
        compared: Explanation of the column "change"; empty without this column.
        cells: Cell of a row in the first table and the chart, by the row's label. They are drawn
            only if there are several conditions.
    """

    title: str
    rows: Sequence[Row]
    notes: Sequence[str] = ()
    compared: str = ""
    cells: Mapping[str, Cell] = field(default_factory=dict)

    @property
    def grid(self) -> dict[str, dict[str, Row]]:
        """Rows by view and condition, all conditions in each view; empty with one condition."""
        grid: dict[str, dict[str, Row]] = defaultdict(dict)
        for row in self.rows:
            if row.label in self.cells:
                view, condition = self.cells[row.label]
                grid[view][condition] = row
        conditions = dict.fromkeys(c for rows in grid.values() for c in rows)
        if len(conditions) < 2:
            return {}
        empty = Row("", ())
        return {view: {c: rows.get(c, empty) for c in conditions} for view, rows in grid.items()}

    @property
    def first(self) -> EvaluationResult:
        """First record; all records have the same scores and classes."""
        return self.rows[0].records[0]

    @property
    def cell_score(self) -> str:
        """Name of the score in the cells: the main score, by solid angle if that exists."""
        by_angle = self.first.main + SOLID_ANGLE
        return by_angle if by_angle in self.first.columns else self.first.main

    def tables(self) -> list[Table]:
        """Return the tables of views in conditions, of means, of classes and of latitude bands."""
        banded = [row for row in self.rows if row.bands]
        tables = [*self._views(), self._overall(), *self._per_class()]
        if banded:
            bands, name = banded[0].bands, self.first.main
            heading = self.first.columns[name]
            rows = [
                (row.label, *(score_text(row.score(name, b).mean, heading.unit) for b in bands))
                for row in banded
            ]
            header = ("", *(f"{south:g}° … {north:g}°" for south, north in bands))
            tables.append(Table(f"{heading.title} by latitude", header, rows))
        return tables

    def _views(self) -> Iterator[Table]:
        grid = self.grid
        if not grid:
            return
        conditions, name = next(iter(grid.values())), self.cell_score
        rows = [
            (view, *(self._cell(row, name, 0) for row in by_condition.values()))
            for view, by_condition in grid.items()
        ]
        title = f"{self.title}: {self.first.columns[name].title}"
        yield Table(title, ("", *conditions), rows, f"{self._legend} {_LEGEND_OF_INTERVALS}")

    @property
    def _legend(self) -> str:
        return "Percent. " * all(h.unit == "%" for h in self.first.columns.values()) + _LEGEND

    def _overall(self) -> Table:
        scores = self.first.main_columns
        names = dict.fromkeys(name for row in self.rows for name in row.facts)
        facts = {name: [row.facts.get(name, "–") for row in self.rows] for name in names}
        alike = [f"{name} {cells[0]}" for name, cells in facts.items() if len(set(cells)) == 1]
        columns = [("", [row.label for row in self.rows])]
        columns += [(name, cells) for name, cells in facts.items() if len(set(cells)) > 1]
        texts = range(len(columns))
        for name, heading in scores.items():
            cells = [self._cell(row, name, len(row.folds)) for row in self.rows]
            columns.append((heading.title, cells))
            if self.compared and not name.endswith(SOLID_ANGLE):
                columns.append(("change", [_change(row.kept(name).mean) for row in self.rows]))
        header, cells_of = zip(*columns, strict=True)
        common = f"{'; '.join(alike)}." if alike else ""
        shown = any(row.score(name).interval for row in self.rows for name in scores)
        intervals = _LEGEND_OF_INTERVALS if shown else ""
        note = " ".join(filter(None, (common, self._legend, intervals, self.compared)))
        return Table(self.title, header, list(zip(*cells_of, strict=True)), note, texts)

    def _per_class(self) -> Iterator[Table]:
        classes = self.first.class_names
        for name, mean in self.first.class_means.items():
            rows = [
                (row.label, *(self._cell(row, name, len(row.folds), c) for c in classes))
                for row in self.rows
                if not name.endswith(SOLID_ANGLE)
                and any(row.score(name, c).mean is not None for c in classes)
            ]
            if rows:
                title = self.first.columns[mean].class_title
                yield Table(f"{title[:1].upper()}{title[1:]}", ("", *classes), rows)

    def _cell(self, row: Row, name: str, folds: int, part: str | None = None) -> str:
        """Return a score with its spreads, and "of 2" if it is over fewer folds than the row."""
        score = row.score(name, part)
        if score.mean is None:
            return "–"
        mean = name if part is None else self.first.class_means[name]
        text = partial(score_text, unit=self.first.columns[mean].unit)
        over_folds = "" if score.over_folds is None else f" ± {text(score.over_folds)}"
        over_seeds = "" if score.over_seeds is None else f" (± {text(score.over_seeds)})"
        count = f" of {score.folds}" if score.folds < folds else ""
        return text(score.mean, interval=score.interval) + over_folds + over_seeds + count

    def all_notes(self) -> list[str]:
        """Return the notes, with those on missing folds."""
        incomplete: dict[str, list[str]] = defaultdict(list)
        for row in self.rows:
            missing = [str(fold) for fold in FOLDS if fold not in row.folds]
            if missing and row.folds != (None,) and not row.published:
                incomplete[" and ".join(missing)].append(row.label)
        notes = [
            f"{', '.join(labels)}: fold {folds} missing; not a mean of {len(FOLDS)} folds."
            for folds, labels in incomplete.items()
        ]
        return [*notes, *self.notes]

    def write(self, folder: Path, name: str) -> None:
        """Write the report as ``.md``, ``.csv`` and ``.png``, each atomically.

        Args:
            folder: Output folder.
            name: Name of the files.
        """
        write_text(folder / f"{name}.md", self._markdown())
        figures = list(self.figures())
        columns = list(dict.fromkeys(key for figure in figures for key in figure))
        write_text(folder / f"{name}.csv", csv_text(columns, figures))
        if self.grid:
            heading = self.first.columns[self.cell_score]
            title = f"{self.title}: {heading.text}"
            png = grid_png(title, self.grid, self.cell_score, heading.unit)
        else:
            png = report_png(self.title, self.rows)
        write_bytes(folder / f"{name}.png", png)

    def figures(self) -> Iterator[dict[str, Any]]:
        """Yield the lines of the CSV file.

        There is a line for each row, fold ("mean" over all folds), class or band, and score.
        """
        first = self.first
        for row in self.rows:
            scopes = [(fold, row.of_fold(fold)) for fold in row.folds if fold is not None]
            for fold, part in [*scopes, ("mean", row)]:
                facts = {"row": row.label, **row.facts, "fold": fold}
                entries: list[tuple[str, str | Band | None, str]]
                entries = [("mean", None, name) for name in first.columns]
                entries += [(c, c, name) for c in first.class_names for name in first.class_means]
                entries += [
                    ("mean", band, name)
                    for band in row.bands
                    for name in first.columns
                    if name in row.records[0].latitude_bands[0]
                ]
                for class_name, section, name in entries:
                    south, north = section if isinstance(section, tuple) else (None, None)
                    yield {
                        **facts,
                        "class": class_name,
                        "south": south,
                        "north": north,
                        "score": name,
                        **part.score(name, section)._asdict(),
                        "kept": part.kept(name, section).mean,
                    }

    def _markdown(self) -> str:
        first, *others = (table.markdown() for table in self.tables())
        notes = "".join(f"- {note}\n" for note in self.all_notes())
        runs = [
            (row.label, str(r.fold or "–"), str(r.seed), str(r.folder))
            for row in self.rows
            if not row.published
            for r in row.records
        ]
        table = Table("Runs", ("", "fold", "seed", "run"), runs, text_columns=(0, 3))
        return "\n".join([f"# {first[3:]}", notes, *others, table.markdown()])


def _change(kept: float | None) -> str:
    """Return the ratio to another score as a relative change in percent.

    >>> _change(0.955), _change(1.026), _change(0.9999)
    ('−4.5 %', '+2.6 %', '+0.0 %')
    """
    if kept is None:
        return "–"
    rounded = round(100 * (kept - 1), 1) + 0.0  # no −0.0
    return f"{rounded:+.1f} %".replace("-", "−")
