"""The result of an evaluation: its data, settings and scores, its tables and its files.

The folder of a finished run contains ``results.json``, and the settings as ``config.yaml``.
"""

from __future__ import annotations

import io
import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import yaml  # type: ignore[import-untyped]
from pydantic import TypeAdapter

from tangent_train.errors import DataError, counted, listed
from tangent_train.files import csv_text, read_json, write_bytes, write_text
from tangent_train.metrics.image_sums import Sums, as_sums, drawn_scores, intervals, means_of_sums
from tangent_train.metrics.scores import BAND_EDGES_DEG, Interval, ScoreColumn
from tangent_train.results.tables import Table, markdown_text, score_text

if TYPE_CHECKING:
    from tangent_train.heads import Head

RESULTS_FILE, SUMS_FILE = "results.json", "results.npz"

Band = tuple[float, float]
"""South and north of a latitude band, in degrees."""

_COUNTS = {"images": "images", "share": "pixels %"}
"""Titles of the columns per class that are not scores."""


@dataclass(frozen=True)
class EvaluationResult:
    """One evaluation. Scores are shares of 1, or in a unit; None if undefined.

    Attributes:
        noun: Plural name of the images: panoramas, photos, shapes.
        images: Number of images.
        columns: Names and units of all scores, in the order of the tables.
        scores: Scores over all images. The first is the main score, used by charts and latitudes.
        classes: Name (``class``) and scores of each class; empty without classes.
        latitude_bands: Edges ``latitude_deg`` (south, north) and scores of each band; empty for
            photos.
        groups: Name (``group``), number of ``images`` and scores of groups of images, such as
            weathers; empty for data without groups.
        confusion: Counts; rows are true, columns predicted classes. Empty without classes.
        intervals: 95 % bootstrap intervals over the images, for scores that have one.
        protocol: Facts that make scores comparable, see `results.published`.
        checkpoint: File of the network, relative to the run folder if it is inside.
        label_map: File or name of the map to the classes of the data; None without a map.
        folds: All folds of the data set; empty for data without folds.
        settings: Resolved config of the run, with names ``section.setting``; not in the file.
        folder: Run folder; not in the file.
    """

    noun: str
    images: int
    columns: Mapping[str, ScoreColumn]
    scores: Mapping[str, float | None]
    classes: Sequence[Mapping[str, Any]] = ()
    latitude_bands: Sequence[Mapping[str, Any]] = ()
    groups: Sequence[Mapping[str, Any]] = ()
    confusion: Sequence[Sequence[int]] = ()
    intervals: Mapping[str, Interval] = field(default_factory=dict)
    protocol: Mapping[str, str] = field(default_factory=dict)
    checkpoint: str = ""
    label_map: str | None = None
    folds: Sequence[int] = ()
    settings: Mapping[str, Any] = field(default_factory=dict)
    folder: Path = Path()

    @property
    def class_names(self) -> tuple[str, ...]:
        """Names of the classes."""
        return tuple(entry["class"] for entry in self.classes)

    @property
    def main(self) -> str:
        """Name of the main score."""
        return next(iter(self.scores))

    @property
    def main_columns(self) -> dict[str, ScoreColumn]:
        """Columns of the main scores, see `ScoreColumn.is_main`."""
        return {name: column for name, column in self.columns.items() if column.is_main}

    @property
    def class_means(self) -> dict[str, str]:
        """Names of the means by the scores of one class, in the order of the tables."""
        return {c.of_class: name for name, c in self.columns.items() if c.of_class}

    @property
    def main_of_class(self) -> str:
        """Name of the main score of a class; "" without classes."""
        return next(filter(None, (self.columns[name].of_class for name in self.scores)), "")

    @property
    def absent(self) -> tuple[str, ...]:
        """Classes that do not occur in the labels and are left out of the means."""
        return tuple(e["class"] for e in self.classes if e[self.main_of_class] is None)

    @property
    def fold(self) -> int | None:
        """Test fold; None for data without folds."""
        return self.settings.get("data.fold")

    @property
    def seed(self) -> int | None:
        """Seed of the run."""
        return self.settings.get("seed")

    def json(self) -> str:
        """Return the content of ``results.json``."""
        adapter = TypeAdapter(EvaluationResult)
        content = adapter.dump_json(self, indent=1, exclude={"settings", "folder"})
        return content.decode() + "\n"


def evaluation_result(
    head: Head,
    result: Any,
    noun: str,
    images: int,
    sums: Sums | None = None,
    groups: Mapping[str, Sequence[int]] = {},
) -> EvaluationResult:
    """Return the result of an evaluation.

    Args:
        head: Head that the scores come from.
        result: Value of its metric; None if only the consistency was measured.
        noun: Plural name of the images: panoramas, photos, shapes.
        images: Number of images.
        sums: Numbers of each image (`Head.image_sums`); None for the order of the evaluation.
        groups: Places of the images of each group in these.
    """
    consistency = plain_scores(means_of_sums(as_sums(head.consistency)))
    if result is None:
        columns = {name: replace(head.columns[name], is_main=True) for name in consistency}
        ends = intervals(drawn_scores(sums or {}))
        return EvaluationResult(noun, images, columns, consistency, intervals=ends)
    sums = head.image_sums(result) if sums is None else sums
    absent = head.facts.get("absent_class", "skip")
    means, of_classes, bands, confusion = head.scores(result)
    scores = list(zip(*(values.tolist() for values in of_classes.values()), strict=True))
    names = head.class_names[len(head.class_names) - len(scores) :]  # without the unknown class
    edges = itertools.pairwise(BAND_EDGES_DEG)
    return EvaluationResult(
        noun,
        images,
        head.columns,
        {**plain_scores(means), **{n: None for n in head.columns if n not in means}, **consistency},
        classes=[
            {"class": name} | plain_scores(dict(zip(of_classes, values, strict=True)))
            for name, values in zip(names, scores, strict=True)
        ],
        latitude_bands=[
            {"latitude_deg": [south, north]} | plain_scores(band)
            for (north, south), band in zip(edges, bands, strict=False)
        ],
        confusion=() if confusion is None else confusion.tolist(),
        groups=[
            {"group": group, "images": len(places)}
            | plain_scores(means_of_sums(sums, absent, places))
            for group, places in sorted(groups.items())
        ],
        intervals=intervals(drawn_scores(sums, absent)),
    )


def plain_scores(scores: Mapping[str, Any]) -> dict[str, Any]:
    """Replace NaN, which JSON lacks, by None."""
    return {name: None if math.isnan(value) else value for name, value in scores.items()}


def flat_settings(config: Mapping[Any, Any], prefix: str = "") -> dict[str, Any]:
    """Return settings of nested sections by name, ``section.setting``."""
    flat: dict[str, Any] = {}
    for key, value in config.items():
        name = f"{prefix}{key}"
        flat |= flat_settings(value, f"{name}.") if isinstance(value, Mapping) else {name: value}
    return flat


def load_result(folder: Path) -> EvaluationResult:
    """Read the results and settings of a finished run.

    Args:
        folder: Run folder.

    Raises:
        DataError: The results are missing, or were not written by ``tangent-train``.
    """
    expected = "results written by tangent-train or tangent-evaluate"
    result: EvaluationResult = read_json(folder / RESULTS_FILE, expected, kind=EvaluationResult)
    settings = flat_settings(yaml.safe_load((folder / "config.yaml").read_bytes()))
    return replace(result, settings=settings, folder=folder)


def find_runs(folders: Sequence[Path]) -> tuple[list[Path], list[Path]]:
    """Find runs in and below folders, each once, sorted within each folder.

    Returns:
        Finished runs, and runs that were started but have no results.

    Raises:
        DataError: A folder contains no results.
    """
    finished: dict[Path, None] = {}
    begun: set[Path] = set()
    for folder in folders:
        found = sorted(path.parent.resolve() for path in folder.rglob(RESULTS_FILE))
        begun |= {path.parent.resolve() for path in folder.rglob("checkpoints")}
        if not found:
            raise DataError(
                folder / RESULTS_FILE,
                found="no such file, and none below",
                expected="the results of a finished run",
                remedy=f"Finish it: tangent-train resume={folder}" * bool(begun),
            )
        finished |= dict.fromkeys(found)
    return list(finished), sorted(begun - finished.keys())


def headline(result: EvaluationResult) -> str:
    """Return the scores over all images in one line."""
    means = [
        f"{column.text} {_mean(result, name)}\u00a0{column.unit}".strip()
        for name, column in result.main_columns.items()
        if result.scores.get(name) is not None
    ]
    count = len(result.classes)
    some = f", {count - len(result.absent)} of {count} classes" if result.absent else ""
    legend = " (in brackets: 95\u00a0% intervals)" if result.intervals else ""
    return f"{', '.join(means)} over {counted(result.images, result.noun)}".strip() + some + legend


def summary_lines(result: EvaluationResult) -> list[str]:
    """Return the headline and, below it, the facts of the protocol, if there are any."""
    facts = (f"{name.replace('_', ' ')}: {fact}" for name, fact in result.protocol.items())
    return list(filter(None, (headline(result), "; ".join(facts))))


def result_tables(result: EvaluationResult) -> list[Table]:
    """Return a table of scores per class, or over all images, by latitude, and by group.

    A class is omitted if it occurs in neither labels nor predictions and its score is undefined.

    Args:
        result: The evaluation.
    """
    tables = [_per_class(result) if result.classes else _over_all(result)]
    tables.append(_over_all(result, "On the sphere", of_sphere=True))
    bands = [
        {"latitude": "{}° … {}°".format(*band["latitude_deg"]), **band}
        for band in result.latitude_bands
    ]
    for title, firsts, entries in (
        ("By latitude", ["latitude"], bands),
        ("By group", ["group", "images"], result.groups),
    ):
        if entries:
            shown = [n for n in entries[0] if n in result.columns]
            columns = {n: c for n in shown if not (c := result.columns[n]).of_sphere}
            rows = [
                [str(entry[name]) for name in firsts]
                + [score_text(entry[name], c.unit) for name, c in columns.items()]
                for entry in entries
            ]
            tables.append(Table(title, [*firsts, *(c.title for c in columns.values())], rows))
    return [table for table in tables if table.rows]


def _mean(result: EvaluationResult, name: str) -> str:
    unit = result.columns[name].unit
    return score_text(result.scores[name], unit, result.intervals.get(name))


def _over_all(result: EvaluationResult, title: str = "Scores", *, of_sphere: bool = False) -> Table:
    rows = [
        [column.title, _mean(result, name)]
        for name, column in result.columns.items()
        if column.of_sphere == of_sphere and result.scores.get(name) is not None
    ]
    return Table(title, ("score", f"over all {result.noun}"), rows)


def _per_class(result: EvaluationResult) -> Table:
    names = [n for n in result.classes[0] if n != "class"]
    columns = {n: result.columns[mean] for n, mean in result.class_means.items()}
    none = np.zeros((1, len(result.classes)), np.int64)
    predicted = np.sum(result.confusion or none, axis=0)[-len(result.classes) :]
    rows = [
        [entry["class"]]
        + [
            str(entry[n]) if n == "images" else score_text(entry[n], getattr(c, "unit", "%"))
            for n, c in zip(names, map(columns.get, names), strict=True)
        ]
        for entry, count in zip(result.classes, predicted, strict=True)
        if count or entry[result.main_of_class] is not None
    ]
    sizes = {entry["class"]: entry.get("share", entry.get("images")) for entry in result.classes}
    shares = [sizes[row[0]] or 0 for row in rows]
    titles = (columns[n].class_title if n in columns else _COUNTS[n] for n in names)
    means = (_mean(result, result.class_means[n]) if n in columns else "" for n in names)
    rows.append(["mean", *means])
    note = f"Means without classes that do not occur in the labels: {listed(result.absent)}."
    note *= bool(result.absent)
    return Table("Per class", ["class", *titles], rows, note, shares=shares, file=RESULTS_FILE)


def confusion_table(result: EvaluationResult) -> Table:
    """Return the confusion matrix as a heat map, in percent of the true class."""
    first = len(result.confusion) - len(result.classes)  # without the unknown class
    counts = np.asarray(result.confusion, np.float64)[first:]
    shares = counts[:, first:] / np.maximum(counts.sum(axis=1, keepdims=True), 1)
    rows = [
        (name, *(f"{100 * share:.0f}" if share >= 0.005 else "" for share in row))
        for name, row in zip(result.class_names, shares, strict=True)
    ]
    note = "Rows: ground truth; columns: prediction; % of the row."
    return Table("Confusion", ("", *result.class_names), rows, note, shades=shares.tolist())


def write_image_sums(folder: Path, names: Sequence[str], sums: Sums) -> None:
    """Write ``results.npz``: the name and the numbers of each image, see `Head.image_sums`."""
    if sums:
        content = io.BytesIO()
        arrays: dict[str, Any] = {"images": np.array(names, np.str_), **sums}
        np.savez_compressed(content, **arrays)
        write_bytes(folder / SUMS_FILE, content.getvalue())


def write_results(
    result: EvaluationResult,
    folder: Path,
    notes: Sequence[str] = (),
    published: Sequence[Table] = (),
) -> None:
    """Write ``results.json``, ``.csv`` and ``.md``, each atomically.

    Args:
        result: The evaluation.
        folder: Output folder.
        notes: Paragraphs in ``results.md`` below the headline.
        published: Tables of published scores in ``results.md``.
    """
    write_text(folder / RESULTS_FILE, result.json())
    network = {"checkpoint": result.checkpoint, "label_map": result.label_map}
    lines = [{**entry, **network} for entry in result.classes or [result.scores]]
    write_text(folder / "results.csv", csv_text(list(lines[0]), lines))
    tables = "\n".join(table.markdown() for table in (*result_tables(result), *published))
    text = "\n\n".join(["# Results", *map(markdown_text, (*summary_lines(result), *notes)), tables])
    write_text(folder / "results.md", text)
