"""Results of a classification as JSON, CSV, Markdown, a picture and a table for the terminal."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from rich.table import Table

from tangent_train.files import write_bytes
from tangent_train.metrics.classification import classification_scores
from tangent_train.results.confusion_picture import confusion_picture
from tangent_train.results.segmentation import (
    counted,
    markdown_line,
    per_class_table,
    percent,
    plain,
    write_files,
)

__all__ = [
    "classification_results",
    "classification_rows",
    "classification_table",
    "write_classification_results",
]

_COLUMNS = ("class", "images", "accuracy", "taken_for", "taken_for_share")


def classification_results(
    confusion: NDArray[np.int64], class_names: Sequence[str], noun: str = "shapes"
) -> dict[str, Any]:
    """All figures of an evaluation, as plain values.

    Args:
        confusion: ``(K, K)`` counts, rows truth, columns prediction.
        class_names: K names.
        noun: What was classified, in the plural.

    Returns:
        Overall and mean per-class accuracy, figures per class, the confusion matrix; shares of 1,
        not percent, and None for what is not defined.
    """
    scores = classification_scores(confusion)
    classes = []
    for k, name in enumerate(class_names):
        other, share = _mostly_taken_for(confusion[k], k)
        classes.append(
            {
                "class": name,
                "images": int(scores.counts[k]),
                "accuracy": plain(scores.of_class[k]),
                "taken_for": None if other is None else class_names[other],
                "taken_for_share": share,
            }
        )
    return {
        "kind": "classification",
        "images": int(confusion.sum()),
        "noun": noun,
        "accuracy": plain(scores.accuracy),
        "class_accuracy": plain(scores.class_accuracy),
        "classes": classes,
        "confusion": confusion.tolist(),
    }


def _mostly_taken_for(row: NDArray[np.int64], own: int) -> tuple[int | None, float | None]:
    """The other class that most of a class went to, and its share; the first of equals."""
    missed = row.copy()
    missed[own] = 0
    if not missed.any():
        return None, None
    other = int(missed.argmax())
    return other, float(missed[other] / row.sum())


def write_classification_results(results: dict[str, Any], folder: Path) -> None:
    """Write ``results.json``, ``.csv``, ``.md`` and ``confusion.png``, each atomically.

    Args:
        results: From `classification_results`.
        folder: Where to.
    """
    write_files(results, _COLUMNS, _markdown(results), folder)
    names = [entry["class"] for entry in results["classes"]]
    picture = confusion_picture(results["confusion"], names, unknown=False)
    encoded = cv2.imencode(".png", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))[1]
    write_bytes(folder / "confusion.png", encoded.tobytes())


def classification_table(results: dict[str, Any]) -> Table:
    """The per-class table for the terminal.

    Args:
        results: From `classification_results`.
    """
    return per_class_table(counted(results), classification_rows(results), None, left=(0, 3))


def classification_rows(results: dict[str, Any]) -> list[tuple[str, ...]]:
    """The per-class table as text: header, a row per class, mean of the classes, overall.

    Args:
        results: From `classification_results`.
    """
    header = ("class", results["noun"], "accuracy %", "most often taken for", "%")
    rows = [
        (
            entry["class"],
            str(entry["images"]),
            percent(entry["accuracy"]),
            entry["taken_for"] or "–",
            percent(entry["taken_for_share"]),
        )
        for entry in results["classes"]
    ]
    mean = ("mean of the classes", "", percent(results["class_accuracy"]), "", "")
    overall = (f"all {results['noun']}", str(results["images"]), percent(results["accuracy"]))
    return [header, *rows, mean, (*overall, "", "")]


def _markdown(results: dict[str, Any]) -> str:
    header, *rows = classification_rows(results)
    rule = ("---", "---:", "---:", "---", "---:")
    lines = [f"# Results over {counted(results)}", ""]
    return "\n".join([*lines, *map(markdown_line, (header, rule, *rows))]) + "\n"
