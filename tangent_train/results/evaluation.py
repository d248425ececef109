"""Record, tables and files of an evaluation, from its confusion matrices."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tangent_train.errors import counted
from tangent_train.files import csv_text, write_text
from tangent_train.metrics.classification import classification_scores
from tangent_train.metrics.segmentation import (
    BAND_EDGES_DEG,
    AbsentClass,
    ConfusionMatrices,
    bootstrap_intervals,
    segmentation_scores,
)
from tangent_train.results.record import RESULTS_FILE, SCORES, Record, with_solid_angle
from tangent_train.results.tables import Table, percent

_HEADINGS = {
    "images": "images",
    "share": "pixels %",
    "taken_for": "most often taken for",
    "taken_for_share": "%",
}
"""Of the columns per class that are no scores."""


def segmentation_record(
    matrices: ConfusionMatrices,
    class_names: Sequence[str],
    absent_class: AbsentClass,
    noun: str = "panoramas",
) -> Record:
    """The record of a segmentation.

    Args:
        matrices: Counts over the data set.
        class_names: K + 1 names, the unknown class first.
        absent_class: Treatment of classes absent from the ground truth in the means.
        noun: Plural name of the images. Photos have neither solid angles nor latitude bands.
    """
    on_sphere = bool(matrices.solid_angle.any())
    absent = absent_class, absent_class if on_sphere else "skip"
    both = list(map(segmentation_scores, (matrices.pixels, matrices.solid_angle), absent))
    means = with_solid_angle(*({"miou": s.miou, "macc": s.macc} for s in both))
    of_class = with_solid_angle(*({"iou": s.iou, "accuracy": s.accuracy} for s in both))
    bands = [segmentation_scores(band, absent_class) for band in matrices.bands if on_sphere]
    of_images = matrices.of_images.swapaxes(0, 1)
    return Record(
        "segmentation",
        noun,
        matrices.images,
        _plain(means),
        _entries(of_class | {"share": both[0].share}, matrices.pixels, class_names, first=1),
        [
            {"latitude_deg": [south, north], **_plain({"miou": band.miou, "macc": band.macc})}
            for north, south, band in zip(BAND_EDGES_DEG, BAND_EDGES_DEG[1:], bands, strict=False)
        ],
        matrices.pixels.tolist(),
        absent_class,
        with_solid_angle(*map(bootstrap_intervals, of_images, absent)),
    )


def classification_record(
    confusion: NDArray[np.int64], class_names: Sequence[str], noun: str = "shapes"
) -> Record:
    """The record of a classification.

    Args:
        confusion: ``(K, K)`` counts, rows truth, columns prediction.
        class_names: K names.
        noun: Plural name of the images.
    """
    scores = classification_scores(confusion)
    means = {"accuracy": scores.accuracy, "class_accuracy": scores.class_accuracy}
    of_class = {"images": scores.counts, "accuracy": scores.of_class}
    return Record(
        "classification",
        noun,
        int(confusion.sum()),
        _plain(means),
        _entries(of_class, confusion, class_names),
        confusion=confusion.tolist(),
    )


def _entries(
    scores: Mapping[str, NDArray[Any]],
    confusion: NDArray[np.int64],
    class_names: Sequence[str],
    first: int = 0,
) -> list[dict[str, Any]]:
    """For each class from the first its name and scores, and what it was most often taken for."""
    return [
        {"class": class_names[k]}
        | _plain({name: values[k - first].item() for name, values in scores.items()})
        | _taken_for(confusion[k], k, class_names)
        for k in range(first, len(class_names))
    ]


def _taken_for(row: NDArray[np.int64], own: int, class_names: Sequence[str]) -> dict[str, Any]:
    """Most frequent confusion of a class, and its share; the first of equals."""
    missed = row.copy()
    missed[own] = 0
    other = int(missed.argmax())
    if not missed[other]:
        return {"taken_for": None, "taken_for_share": None}
    return {"taken_for": class_names[other], "taken_for_share": float(missed[other] / row.sum())}


def _plain(scores: Mapping[str, Any]) -> dict[str, Any]:
    """None for NaN, which JSON does not have."""
    return {name: None if math.isnan(value) else value for name, value in scores.items()}


def headline(record: Record) -> str:
    """The scores over all classes in one line."""
    means = [
        f"{heading} {percent(record.means[name], record.intervals.get(name))}\u00a0%"
        for name, heading in SCORES[record.kind].means.items()
        if record.means[name] is not None
    ]
    absent = record.absent
    some = f", {len(record.classes) - len(absent)} of {len(record.classes)} classes"
    told = " (in brackets: 95\u00a0% intervals)" if record.intervals else ""
    over = counted(record.images, record.noun) + (some if absent else "")
    return f"{', '.join(means)} over {over}".strip() + told


def result_tables(record: Record) -> list[Table]:
    """The scores per class, with their means, and per latitude band.

    Classes that neither the labels nor the predictions have are left out, if their scores are.

    Args:
        record: Of an evaluation.
    """
    scores = SCORES[record.kind]
    columns = [
        name
        for name in record.classes[0]
        if name != "class" and (record.latitude_bands or not name.endswith("_solid_angle"))
    ]
    headings = {**_HEADINGS, **{name: f"{text} %" for name, text in scores.per_class.items()}}
    counts = np.asarray(record.confusion, np.float64)[-len(record.classes) :]
    predicted = counts.sum(axis=0)[-len(record.classes) :]
    rows = [
        [e["class"], *(_cell(e[name]) for name in columns)]
        for e, count in zip(record.classes, predicted, strict=True)
        if count or e["accuracy"] is not None
    ]
    names = map(scores.mean_of.get, columns)
    means = (percent(record.means[n], record.intervals.get(n)) if n else "" for n in names)
    rows.append(["mean", *means])
    texts = [0, *(1 + k for k, name in enumerate(columns) if name == "taken_for")]
    header = ["class", *(headings[name] for name in columns)]
    note = f"Means without classes that no label has: {', '.join(record.absent)}."
    tables = [Table("Per class", header, rows, note if record.absent else "", text_columns=texts)]
    if record.latitude_bands:
        rows = [
            ["{}° … {}°".format(*b["latitude_deg"]), _cell(b["miou"]), _cell(b["macc"])]
            for b in record.latitude_bands
        ]
        tables.append(Table("By latitude", ("latitude", "mIoU %", "mAcc %"), rows))
    return tables


def _cell(value: Any) -> str:
    return percent(value) if value is None or isinstance(value, float) else str(value)


def confusion_table(record: Record) -> Table:
    """The confusion matrix as a heat map: percent of the true class."""
    first = int(record.kind == "segmentation")  # without the unknown class
    counts = np.asarray(record.confusion, np.float64)[first:]
    shares = counts[:, first:] / np.maximum(counts.sum(axis=1, keepdims=True), 1)
    rows = [
        (name, *(f"{100 * share:.0f}" if share >= 0.005 else "" for share in row))
        for name, row in zip(record.class_names, shares, strict=True)
    ]
    note = "Rows: truth; columns: prediction; % of the row."
    return Table("Confusion", ("", *record.class_names), rows, note, shades=shares.tolist())


def write_results(record: Record, folder: Path, notes: Sequence[str] = ()) -> None:
    """Write ``results.json``, ``.csv`` and ``.md``, each atomically.

    Args:
        record: Of an evaluation.
        folder: Output folder.
        notes: Paragraphs of ``.md`` below the headline.
    """
    write_text(folder / RESULTS_FILE, record.json())
    network = {"checkpoint": record.checkpoint, "class_map": record.class_map}
    lines = [{**entry, **network} for entry in record.classes]
    write_text(folder / "results.csv", csv_text(list(lines[0]), lines))
    tables = "\n".join(table.markdown() for table in result_tables(record))
    text = "\n\n".join(["# Results", headline(record), *notes, tables])
    write_text(folder / "results.md", text)
