"""Results of an evaluation as JSON, CSV, Markdown and a table for the terminal."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.markup import escape
from rich.table import Table

from tangent_train.csv_text import csv_text
from tangent_train.files import write_text
from tangent_train.metrics.segmentation import (
    BAND_EDGES_DEG,
    UNKNOWN,
    AbsentClass,
    ConfusionMatrices,
    segmentation_scores,
)

__all__ = [
    "counted",
    "evaluation_results",
    "largest_loss",
    "markdown_line",
    "per_class_table",
    "percent",
    "plain",
    "results_table",
    "write_files",
    "write_results",
]

_COLUMNS = ("class", "iou", "accuracy", "iou_solid_angle", "accuracy_solid_angle", "share")


def evaluation_results(
    matrices: ConfusionMatrices,
    class_names: Sequence[str],
    absent_class: AbsentClass,
    noun: str = "panoramas",
) -> dict[str, Any]:
    """All figures of an evaluation, as plain values.

    Args:
        matrices: What was counted.
        class_names: K + 1 names, the unknown class first.
        absent_class: What absent classes do to the means.
        noun: What was scored, in the plural. Photos have neither solid angles nor latitude bands.

    Returns:
        Means, per-class and per-band figures, the confusion matrix; shares of 1, not percent, and
        None for what is not defined.
    """
    pixels = segmentation_scores(matrices.pixels, absent_class)
    on_sphere = matrices.solid_angle.any()
    solid = segmentation_scores(matrices.solid_angle, absent_class if on_sphere else "skip")
    per_class = [
        dict(zip(_COLUMNS, (name, *map(plain, figures)), strict=True))
        for name, *figures in zip(
            class_names[1:],
            pixels.iou,
            pixels.accuracy,
            solid.iou,
            solid.accuracy,
            pixels.share,
            strict=True,
        )
    ]
    bands = [
        {
            "latitude_deg": [south, north],
            "miou": plain(scores.miou),
            "macc": plain(scores.macc),
        }
        for north, south, scores in zip(
            BAND_EDGES_DEG[:-1],
            BAND_EDGES_DEG[1:],
            (segmentation_scores(band, absent_class) for band in matrices.bands),
            strict=True,
        )
        if on_sphere
    ]
    return {
        "images": matrices.images,
        "noun": noun,
        "miou": plain(pixels.miou),
        "macc": plain(pixels.macc),
        "miou_solid_angle": plain(solid.miou),
        "macc_solid_angle": plain(solid.macc),
        "absent_class": absent_class,
        "classes": per_class,
        "latitude_bands": bands,
        "confusion": matrices.pixels.tolist(),
    }


def write_results(results: dict[str, Any], folder: Path) -> None:
    """Write ``results.json``, ``results.csv`` and ``results.md``, each atomically.

    Args:
        results: From `evaluation_results`, perhaps with more plain values.
        folder: Where to.
    """
    write_files(results, _COLUMNS, _markdown(results), folder)


def write_files(
    results: dict[str, Any], columns: Sequence[str], markdown: str, folder: Path
) -> None:
    """Write results as JSON, those of the classes as CSV, and a text, each atomically.

    Args:
        results: With a list of ``classes``.
        columns: Of the CSV file, figures of a class.
        markdown: The text.
        folder: Where to.
    """
    write_text(folder / "results.json", json.dumps(results, indent=1) + "\n")
    write_text(folder / "results.csv", csv_text(columns, results["classes"]))
    write_text(folder / "results.md", markdown)


def per_class_table(
    title: str, rows: Sequence[Sequence[str]], caption: str | None, left: Sequence[int] = (0,)
) -> Table:
    """A table for the terminal, its last row bold.

    Args:
        title: Stands above.
        rows: The first is the header.
        caption: Stands below.
        left: Columns of text; the others are of numbers.
    """
    table = Table(title=title, caption=None if caption is None else escape(caption))
    header, *others = rows
    for k, name in enumerate(header):
        table.add_column(name, justify="left" if k in left else "right")
    for row in others:
        table.add_row(*map(escape, row), style="bold" if row is others[-1] else None)
    return table


def results_table(results: dict[str, Any]) -> Table:
    """The per-class table for the terminal, with the largest loss below.

    Args:
        results: From `evaluation_results`.
    """
    return per_class_table(counted(results), _rows(results), largest_loss(results))


def largest_loss(results: dict[str, Any]) -> str | None:
    """The class that takes most from the mean IoU, 100 % less its own, and where it went.

    Args:
        results: From `evaluation_results`.

    Returns:
        A sentence; None where no class is labelled. Classes without labelled pixels are not named,
        of equals the one with most.
    """
    confusion = np.asarray(results["confusion"], np.float64)
    labelled = [k for k, row in enumerate(confusion[1:], start=1) if row.any()]
    if not labelled:
        return None
    names = ["unknown", *(entry["class"] for entry in results["classes"])]
    ious = {k: results["classes"][k - 1]["iou"] for k in labelled}
    worst = min(labelled, key=lambda k: (float(ious[k]), -confusion[k].sum()))
    if ious[worst] == 1:
        return "No loss: every labelled class has 100 % IoU."
    return f"Largest loss: {names[worst]}, {percent(ious[worst])} % IoU; " + _where_it_went(
        confusion, worst, names
    )


def _where_it_went(confusion: NDArray[np.float64], worst: int, names: Sequence[str]) -> str:
    """What a class is mostly taken for; where all of it was found, what is taken for it."""
    missed, wrong = confusion[worst].copy(), confusion[:, worst].copy()
    missed[worst] = wrong[worst] = wrong[UNKNOWN] = 0
    if missed.any():
        other = int(missed.argmax())
        share = percent(missed[other] / confusion[worst].sum())
        return f"most often taken for {names[other]} ({share} % of its pixels)."
    other = int(wrong.argmax())
    share = percent(wrong[other] / confusion[UNKNOWN + 1 :, worst].sum())
    return f"all of it was found, but {share} % of what was taken for it is {names[other]}."


def _rows(results: dict[str, Any]) -> list[tuple[str, ...]]:
    header = ("class", "IoU %", "acc. %", "IoU % by solid angle", "acc. %", "pixels %")
    rows = [header]
    rows += [
        (entry["class"], *(percent(entry[column]) for column in _COLUMNS[1:]))
        for entry in results["classes"]
    ]
    means = (results[k] for k in ("miou", "macc", "miou_solid_angle", "macc_solid_angle"))
    return [*rows, ("mean", *map(percent, means), "")]


def _markdown(results: dict[str, Any]) -> str:
    header, *rows = _rows(results)
    lines = [f"# Results over {counted(results)}", "", markdown_line(header)]
    lines += [markdown_line(["---"] + ["---:"] * (len(header) - 1)), *map(markdown_line, rows), ""]
    loss = largest_loss(results)
    lines += [loss, ""] if loss is not None else []
    if results["latitude_bands"]:
        lines += ["| latitude | mIoU % | mAcc % |", "| --- | ---: | ---: |"]
    for band in results["latitude_bands"]:
        south, north = band["latitude_deg"]
        figures = (percent(band["miou"]), percent(band["macc"]))
        lines.append(markdown_line((f"{south}° … {north}°", *figures)))
    return "\n".join(lines) + "\n"


def counted(results: dict[str, Any]) -> str:
    """What was scored and how many, as in "44 panoramas"."""
    return f"{results['images']} {results['noun']}"


def markdown_line(cells: Sequence[str]) -> str:
    """A line of a Markdown table."""
    return "| " + " | ".join(cells) + " |"


def plain(value: float) -> float | None:
    """A figure for JSON; None for what is not defined."""
    return None if math.isnan(value) else float(value)


def percent(value: float | None) -> str:
    """A share of 1 in percent, for tables; a dash where there is none."""
    return "–" if value is None else f"{100 * value:.1f}"
