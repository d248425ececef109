"""Write the tables and files of one evaluation, and build its parts."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tangent_train.errors import counted
from tangent_train.files import csv_text, write_text
from tangent_train.heads import Head
from tangent_train.metrics.score_columns import SOLID_ANGLE
from tangent_train.metrics.segmentation import BAND_EDGES_DEG
from tangent_train.results.evaluation_result import RESULTS_FILE, EvaluationResult, plain_scores
from tangent_train.results.tables import Table, score_text

_OTHER_COLUMNS = {"images": "images", "share": "pixels %"}
"""Titles of the columns per class that are not scores."""


def evaluation_result(head: Head, result: Any, noun: str, images: int) -> EvaluationResult:
    """Return the result of an evaluation.

    Args:
        head: Head that the scores come from.
        result: Value of its metric.
        noun: Plural name of the images: panoramas, photos, shapes.
        images: Number of images.
    """
    means, of_classes, bands, confusion = head.scores(result)
    return EvaluationResult(
        noun,
        images,
        head.columns,
        {**plain_scores(means), **{name: None for name in head.columns if name not in means}},
        classes=class_entries(of_classes, head.class_names),
        latitude_bands=latitude_entries(bands) if bands else (),
        confusion=() if confusion is None else confusion.tolist(),
        intervals=head.intervals(result),
    )


def class_entries(
    scores: Mapping[str, NDArray[Any]], class_names: Sequence[str]
) -> list[dict[str, Any]]:
    """Return name and scores of each class, see `EvaluationResult`.

    Args:
        scores: Scores of the classes ``(K,)`` by name; empty without classes.
        class_names: Names of the K classes, or of K + 1 labels with the unknown class first.
    """
    of_classes = zip(*(values.tolist() for values in scores.values()), strict=True)
    rows = [plain_scores(dict(zip(scores, values, strict=True))) for values in of_classes]
    names = class_names[len(class_names) - len(rows) :]
    return [{"class": name} | row for name, row in zip(names, rows, strict=True)]


def latitude_entries(scores: Iterable[Mapping[str, float]]) -> list[dict[str, Any]]:
    """Return edges and scores of latitude bands, see `EvaluationResult.latitude_bands`.

    Args:
        scores: Scores of the bands, from north to south.
    """
    return [
        {"latitude_deg": [south, north]} | plain_scores(of_band)
        for (north, south), of_band in zip(itertools.pairwise(BAND_EDGES_DEG), scores, strict=True)
    ]


def headline(result: EvaluationResult) -> str:
    """Return the scores over all images in one line."""
    means = [
        f"{h.text} {score_text(value, h.unit, result.intervals.get(name))}\u00a0{h.unit}".strip()
        for name, h in result.main_columns.items()
        if (value := result.scores.get(name)) is not None
    ]
    absent = result.absent
    some = f", {len(result.classes) - len(absent)} of {len(result.classes)} classes"
    legend = " (in brackets: 95\u00a0% intervals)" if result.intervals else ""
    over = counted(result.images, result.noun) + (some if absent else "")
    return f"{', '.join(means)} over {over}".strip() + legend


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
    bands = [["{}° … {}°".format(*band["latitude_deg"])] for band in result.latitude_bands]
    groups = [[group["group"], str(group["images"])] for group in result.groups]
    for title, firsts, entries, header in (
        ("By latitude", bands, result.latitude_bands, ["latitude"]),
        ("By group", groups, result.groups, ["group", "images"]),
    ):
        if entries:
            columns = {n: result.columns[n] for n in entries[0] if n in result.columns}
            rows = [
                [*first, *(score_text(entry[name], c.unit) for name, c in columns.items())]
                for first, entry in zip(firsts, entries, strict=True)
            ]
            titles = (column.title for column in columns.values())
            tables.append(Table(title, [*header, *titles], rows))
    return tables


def _mean(result: EvaluationResult, name: str) -> str:
    unit = result.columns[name].unit
    return score_text(result.scores[name], unit, result.intervals.get(name))


def _over_all(result: EvaluationResult) -> Table:
    rows = [
        [column.title, _mean(result, name)]
        for name, column in result.columns.items()
        if result.latitude_bands or not name.endswith(SOLID_ANGLE)
    ]
    return Table("Scores", ("score", f"over all {result.noun}"), rows)


def _per_class(result: EvaluationResult) -> Table:
    mean_of = result.class_means
    titles = _OTHER_COLUMNS | {
        name: result.columns[mean].class_title for name, mean in mean_of.items()
    }
    units = {name: result.columns[mean].unit for name, mean in mean_of.items()}
    columns = [
        name
        for name in result.classes[0]
        if name != "class" and (result.latitude_bands or not name.endswith(SOLID_ANGLE))
    ]
    predicted = np.sum(result.confusion, axis=0)[-len(result.classes) :]
    rows = [
        [entry["class"], *(_cell(entry[name], units.get(name, "%")) for name in columns)]
        for entry, count in zip(result.classes, predicted, strict=True)
        if count or entry[result.main_of_class] is not None
    ]
    means = (_mean(result, mean_of[name]) if name in mean_of else "" for name in columns)
    note = f"Means without classes that do not occur in the labels: {', '.join(result.absent)}."
    return Table(
        "Per class",
        ["class", *(titles[name] for name in columns)],
        [*rows, ["mean", *means]],
        note if result.absent else "",
    )


def _cell(value: Any, unit: str) -> str:
    return score_text(value, unit) if value is None or isinstance(value, float) else str(value)


def confusion_table(result: EvaluationResult) -> Table:
    """Return the confusion matrix as a heat map, in percent of the true class."""
    first = len(result.confusion) - len(result.classes)  # without the unknown class
    counts = np.asarray(result.confusion, np.float64)[first:]
    shares = counts[:, first:] / np.maximum(counts.sum(axis=1, keepdims=True), 1)
    rows = [
        (name, *(f"{100 * share:.0f}" if share >= 0.005 else "" for share in row))
        for name, row in zip(result.class_names, shares, strict=True)
    ]
    note = "Rows: truth; columns: prediction; % of the row."
    return Table("Confusion", ("", *result.class_names), rows, note, shades=shares.tolist())


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
    text = "\n\n".join(["# Results", *summary_lines(result), *notes, tables])
    write_text(folder / "results.md", text)
