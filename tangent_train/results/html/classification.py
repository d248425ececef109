"""The report of a classification: its results as tables, the curves of the training."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from tangent_train.results.classification import classification_rows
from tangent_train.results.confusion_picture import row_shares
from tangent_train.results.html.evaluation import heat_table, training_curves
from tangent_train.results.html.page import write_report
from tangent_train.results.html.parts import Table
from tangent_train.results.segmentation import counted, percent

if TYPE_CHECKING:
    from pathlib import Path

__all__ = ["write_classification_report"]


def write_classification_report(path: Path, results: dict[str, Any], checkpoint: Path) -> None:
    """Write the report of an evaluation.

    Args:
        path: The HTML file.
        results: From `classification_results`.
        checkpoint: What was evaluated; curves are drawn where it lies in the folder of its run.
    """
    header, *rows = classification_rows(results)
    names = [entry["class"] for entry in results["classes"]]
    shares = np.nan_to_num(row_shares(results["confusion"], unknown=False))
    figures = f"accuracy {percent(results['accuracy'])}\u00a0%"
    figures += f", mean of the classes {percent(results['class_accuracy'])}\u00a0%"
    write_report(
        path,
        f"Evaluation of {checkpoint.name}",
        tables=[Table("Per class", header, rows), heat_table(names, shares, results["noun"])],
        curves=training_curves(checkpoint.resolve().parent.parent),
        notes=[f"{figures} over {counted(results)}", f"Checkpoint: {checkpoint}"],
    )
