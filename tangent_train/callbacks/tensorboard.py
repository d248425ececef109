"""Pictures and scores per class for TensorBoard."""

from __future__ import annotations

from typing import Any

import numpy as np
from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import Callback
from lightning.pytorch.loggers import TensorBoardLogger
from numpy.typing import NDArray

from tangent_train.errors import at_least
from tangent_train.metrics.classification import classification_scores
from tangent_train.metrics.segmentation import segmentation_scores
from tangent_train.results.pictures import evenly_spread, prediction_panel, shown_arrays

_MOST_ROWS = 256
"""Larger images are shown smaller: an event file holds the pictures of all validations."""


class ValidationPictures(Callback):
    """Shows a few validation images in TensorBoard, after every validation.

    ``val_images/<name>``: input, ground truth, prediction and error; always the same images,
    spread over those of the first process.

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
        image, representation = source.read(index), task.representation
        shown = shown_arrays(image, batch.target[0], outputs[0], representation)
        rgb, truth, labels = map(_smaller, shown)
        panel = prediction_panel(rgb, truth, labels, task.class_names)
        tag = f"val_images/{source.name(index).replace('/', '_')}"
        writer.add_image(tag, panel, _step(trainer), dataformats="HWC")


class ClassScores(Callback):
    """Log per-class scores to TensorBoard after every validation.

    ``val_iou/<class>``, of shapes ``val_accuracy/<class>``, of the classes that occur, at the same
    steps as ``val/miou``. Only the first process writes, and only with a TensorBoard logger.
    """

    def on_validation_end(  # noqa: D102 - a hook of Lightning; the scores are there now
        self, trainer: Trainer, pl_module: LightningModule
    ) -> None:
        writer = _writer(trainer)
        if writer is None:
            return
        task: Any = pl_module
        segmentation = task.kind == "segmentation"
        if segmentation:
            name = "val_iou"
            values = segmentation_scores(task.matrices.pixels, task.absent_class).iou
        else:
            name = "val_accuracy"
            values = classification_scores(task.matrices).of_class
        step = _step(trainer)
        for class_name, value in zip(task.class_names[int(segmentation) :], values, strict=True):
            if not np.isnan(value):
                writer.add_scalar(f"{name}/{class_name}", value, step)


def _smaller(image: NDArray[Any]) -> NDArray[Any]:
    """Downsample to at most `_MOST_ROWS` rows."""
    step = -(-image.shape[0] // _MOST_ROWS)
    return image[step // 2 :: step, step // 2 :: step]


def _writer(trainer: Trainer) -> Any:
    """TensorBoard's writer in the first process, otherwise None."""
    if trainer.sanity_checking or not trainer.is_global_zero:
        return None
    found = (x.experiment for x in trainer.loggers if isinstance(x, TensorBoardLogger))
    return next(found, None)


def _step(trainer: Trainer) -> int:
    """Step at which Lightning logs a validation (one less than `global_step` then)."""
    return trainer.fit_loop.epoch_loop._batches_that_stepped
