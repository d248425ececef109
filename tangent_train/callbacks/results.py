"""The pictures of a run, and the files and the page of its evaluation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from lightning.pytorch.callbacks import Callback

from tangent_train.callbacks.panels import PredictionPanels
from tangent_train.callbacks.tensorboard import ClassScores, ValidationPictures
from tangent_train.results.evaluation import (
    classification_record,
    confusion_table,
    headline,
    result_tables,
    segmentation_record,
    write_results,
)
from tangent_train.results.html import write_report
from tangent_train.results.record import Record


def pictures(kind: str, folder: Path, settings: Mapping[str, Any]) -> list[Callback]:
    """Callbacks that draw the predictions on the validation and test splits.

    Args:
        kind: Kind of the task.
        folder: Folder of the run.
        settings: Settings of the run.
    """
    if kind == "classification":
        return [ClassScores()]
    return [
        ClassScores(),
        PredictionPanels(folder / "panels", settings["panels"]),
        ValidationPictures(settings["tensorboard_images"]),
    ]


def evaluated(task: Any, noun: str) -> Record:
    """The record of the last evaluation of a task.

    Args:
        task: Holds the matrices of that evaluation.
        noun: Plural name of the images.
    """
    if task.kind == "classification":
        return classification_record(task.matrices, task.class_names, noun)
    return segmentation_record(task.matrices, task.class_names, task.absent_class, noun)


def write_evaluation(task: Any, record: Record, folder: Path, notes: Sequence[str] = ()) -> None:
    """Write ``results.*`` and ``report.html``.

    Args:
        task: The evaluated task, still attached to its trainer.
        record: From `evaluated`, with its checkpoint.
        folder: Output folder.
        notes: Further lines.
    """
    notes = [f"Checkpoint: {record.checkpoint}", *notes]
    write_results(record, folder, notes)
    callbacks = task.trainer.callbacks
    write_report(
        folder / "report.html",
        f"Evaluation of {Path(record.checkpoint).name}",
        tables=[*result_tables(record), confusion_table(record)],
        images=[i for c in callbacks if isinstance(c, PredictionPanels) for i in c.images],
        class_names=task.class_names,
        notes=[headline(record), *notes],
    )
