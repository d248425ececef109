"""Pictures and scores per class for TensorBoard."""

from __future__ import annotations

import math
from typing import Any

from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import Callback
from lightning.pytorch.loggers import TensorBoardLogger

from tangent_train.errors import at_least
from tangent_train.results.pictures import evenly_spread

_MOST_ROWS = 256
"""Larger images are shown smaller: an event file holds the pictures of all validations."""


class ValidationPictures(Callback):
    """Shows a few validation images in TensorBoard, after every validation.

    ``val_images/<name>``, see `Task.picture`; always the same images, spread over those of the
    first process.

    Args:
        count: Number of images.

    Raises:
        SettingError: Less than 0.
    """

    def __init__(self, count: int = 4) -> None:
        self.count = at_least("validation_images", count, 0)

    def on_validation_batch_end(  # noqa: D102 - a hook of Lightning
        self,
        trainer: Trainer,
        pl_module: LightningModule,
        outputs: Any,
        batch: Any,
        batch_idx: int,
        dataloader_idx: int = 0,
    ) -> None:
        writer = _writer(trainer)
        chosen = evenly_spread(self.count, int(trainer.num_val_batches[dataloader_idx]))
        if writer is None or batch_idx not in chosen:
            return
        task: Any = pl_module
        data: Any = trainer.datamodule  # type: ignore[attr-defined]
        source, index = data.source("val"), int(batch.index[0])
        labels = task.targets(batch)[0], outputs[0]
        panel = task.picture(source.read(index), *labels, most_rows=_MOST_ROWS)
        if panel is None:
            return
        tag = f"val_images/{source.name(index).replace('/', '_')}"
        writer.add_image(tag, panel, _step(trainer), dataformats="HWC")


class ClassScores(Callback):
    """Log per-class scores to TensorBoard after every validation.

    Such as ``val_iou/<class>``, see `Task.class_scores`, of the classes that occur, at the same
    steps as ``val/miou``. Only the first process writes, and only with a TensorBoard logger.
    """

    def on_validation_end(  # noqa: D102 - a hook of Lightning; the scores are there now
        self, trainer: Trainer, pl_module: LightningModule
    ) -> None:
        writer = _writer(trainer)
        if writer is None:
            return
        task: Any = pl_module
        step = _step(trainer)
        for name, value in task.class_scores(task.result).items():
            if not math.isnan(value):
                writer.add_scalar(f"val_{name}", value, step)


def _writer(trainer: Trainer) -> Any:
    """TensorBoard's writer in the first process, otherwise None."""
    if trainer.sanity_checking or not trainer.is_global_zero:
        return None
    found = (x.experiment for x in trainer.loggers if isinstance(x, TensorBoardLogger))
    return next(found, None)


def _step(trainer: Trainer) -> int:
    """Step at which Lightning logs a validation (one less than `global_step` then)."""
    return trainer.fit_loop.epoch_loop._batches_that_stepped
