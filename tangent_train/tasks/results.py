"""Results of an evaluation as JSON, CSV, Markdown and a table for the terminal."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.table import Table

from tangent_train.files import write_text
from tangent_train.tasks.metrics import (
    BAND_EDGES_DEG,
    AbsentClass,
    ConfusionMatrices,
    segmentation_scores,
)

__all__ = ["evaluation_results", "results_table", "write_results"]

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
        dict(zip(_COLUMNS, (name, *map(_plain, figures)), strict=True))
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
            "miou": _plain(scores.miou),
            "macc": _plain(scores.macc),
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
        "miou": _plain(pixels.miou),
        "macc": _plain(pixels.macc),
        "miou_solid_angle": _plain(solid.miou),
        "macc_solid_angle": _plain(solid.macc),
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
    write_text(folder / "results.json", json.dumps(results, indent=1) + "\n")
    text = io.StringIO()
    writer = csv.DictWriter(text, _COLUMNS, lineterminator="\n")
    writer.writeheader()
    writer.writerows(results["classes"])
    write_text(folder / "results.csv", text.getvalue())
    write_text(folder / "results.md", _markdown(results))


def results_table(results: dict[str, Any]) -> Table:
    """The per-class table for the terminal.

    Args:
        results: From `evaluation_results`.
    """
    table = Table(title=_counted(results))
    header, *rows = _rows(results)
    for k, name in enumerate(header):
        table.add_column(name, justify="right" if k else "left")
    for row in rows:
        table.add_row(*row, style="bold" if row is rows[-1] else None)
    return table


def _rows(results: dict[str, Any]) -> list[tuple[str, ...]]:
    header = ("class", "IoU %", "acc. %", "IoU % by solid angle", "acc. %", "pixels %")
    rows = [header]
    rows += [
        (entry["class"], *(_percent(entry[column]) for column in _COLUMNS[1:]))
        for entry in results["classes"]
    ]
    means = (results[k] for k in ("miou", "macc", "miou_solid_angle", "macc_solid_angle"))
    return [*rows, ("mean", *map(_percent, means), "")]


def _markdown(results: dict[str, Any]) -> str:
    header, *rows = _rows(results)
    lines = [f"# Results over {_counted(results)}", "", _line(header)]
    lines += [_line(["---"] + ["---:"] * (len(header) - 1)), *map(_line, rows), ""]
    if results["latitude_bands"]:
        lines += ["| latitude | mIoU % | mAcc % |", "| --- | ---: | ---: |"]
    for band in results["latitude_bands"]:
        south, north = band["latitude_deg"]
        figures = (_percent(band["miou"]), _percent(band["macc"]))
        lines.append(_line((f"{south}° … {north}°", *figures)))
    return "\n".join(lines) + "\n"


def _counted(results: dict[str, Any]) -> str:
    return f"{results['images']} {results['noun']}"


def _line(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def _plain(value: float) -> float | None:
    return None if math.isnan(value) else float(value)


def _percent(value: float | None) -> str:
    return "–" if value is None else f"{100 * value:.1f}"
