"""Scores per class for TensorBoard."""

from __future__ import annotations

from typing import Any

import numpy as np
from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import Callback

from tangent_train.metrics.classification import classification_scores
from tangent_train.metrics.segmentation import segmentation_scores


class ClassScores(Callback):
    """Log per-class scores to TensorBoard after every validation.

    ``val_iou/<class>``, of shapes ``val_accuracy/<class>``, of the classes that occur, at the same
    steps as ``val/miou``. Only the first process writes.
    """

    def on_validation_end(  # noqa: D102 - a hook of Lightning; the scores are there now
        self, trainer: Trainer, pl_module: LightningModule
    ) -> None:
        if trainer.sanity_checking or not trainer.is_global_zero:
            return
        task: Any = pl_module
        writer = task.logger.experiment
        segmentation = task.kind == "segmentation"
        if segmentation:
            name = "val_iou"
            values = segmentation_scores(task.matrices.pixels, task.absent_class).iou
        else:
            name = "val_accuracy"
            values = classification_scores(task.matrices).of_class
        # That of Lightning's own figures, one less than `global_step` then.
        step = trainer.fit_loop.epoch_loop._batches_that_stepped
        for class_name, value in zip(task.class_names[int(segmentation) :], values, strict=True):
            if not np.isnan(value):
                writer.add_scalar(f"{name}/{class_name}", value, step)
