"""What becomes of an evaluation: the pictures of a run, its results as files and as a page."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lightning.pytorch.callbacks import Callback
from rich.table import Table

from tangent_train.callbacks.panels import PredictionPanels
from tangent_train.callbacks.tensorboard import ValidationConfusion, ValidationPictures
from tangent_train.results.classification import (
    classification_results,
    classification_table,
    write_classification_results,
)
from tangent_train.results.html.classification import write_classification_report
from tangent_train.results.html.evaluation import write_evaluation_report
from tangent_train.results.segmentation import evaluation_results, results_table, write_results

__all__ = ["evaluated", "pictures", "write_evaluation"]


def pictures(kind: str, folder: Path, settings: Mapping[str, Any]) -> list[Callback]:
    """Callbacks that draw the predictions on the validation and test splits.

    Args:
        kind: Of the task.
        folder: Of the run.
        settings: Of the run.
    """
    if kind == "classification":
        return [ValidationConfusion()]
    return [
        PredictionPanels(folder / "panels", settings["panels"]),
        ValidationPictures(settings.get("tensorboard_images", 0)),
    ]


def evaluated(task: Any, noun: str) -> dict[str, Any]:
    """All figures of the last evaluation of a task, as plain values.

    Args:
        task: With the matrices of that evaluation.
        noun: What was scored, in the plural.
    """
    if task.kind == "classification":
        return classification_results(task.matrices, task.class_names, noun)
    return evaluation_results(task.matrices, task.class_names, task.absent_class, noun)


def write_evaluation(task: Any, results: dict[str, Any], checkpoint: Path, folder: Path) -> Table:
    """Write ``results.*`` and ``report.html``.

    Args:
        task: What was evaluated, still attached to its trainer.
        results: From `evaluated`.
        checkpoint: Its weights.
        folder: Where to.

    Returns:
        The table for the terminal.
    """
    page = folder / "report.html"
    if task.kind == "classification":
        write_classification_results(results, folder)
        write_classification_report(page, results, checkpoint)
        return classification_table(results)
    write_results(results, folder)
    callbacks = task.trainer.callbacks
    images = [i for c in callbacks if isinstance(c, PredictionPanels) for i in c.images]
    write_evaluation_report(page, results, task.class_names, images, checkpoint)
    return results_table(results)
