"""Pictures, scores per class and training speed for TensorBoard."""

from __future__ import annotations

import time
from typing import Any

import cv2
import lightning
import numpy as np
import torch
from lightning.pytorch.callbacks import Callback
from lightning.pytorch.loggers import TensorBoardLogger
from numpy.typing import NDArray

from tangent_train.errors import SettingError
from tangent_train.metrics.classification import classification_scores
from tangent_train.metrics.segmentation import segmentation_scores
from tangent_train.results.chart import confusion_picture
from tangent_train.results.pictures import prediction_panel, shown_image, side_by_side

__all__ = ["TrainingSpeed", "ValidationConfusion", "ValidationPictures"]

_MOST_ROWS = 256
"""Larger images are shown smaller: an event file holds the pictures of all validations."""

_PANORAMA_DIMENSIONS = 2


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
        if count < 0:
            raise SettingError("tensorboard_images", found=count, expected="0 or more")
        self.count = count

    def on_validation_batch_end(  # noqa: D102 - a hook of Lightning
        self,
        trainer: lightning.Trainer,
        pl_module: lightning.LightningModule,
        outputs: Any,
        batch: Any,
        batch_idx: int,
        dataloader_idx: int = 0,
    ) -> None:
        writer = _writer(trainer)
        batches = int(trainer.num_val_batches[dataloader_idx])
        chosen = np.linspace(0, batches - 1, min(self.count, batches)).round()
        if writer is None or batch_idx not in chosen:
            return
        target, index = batch.target[0], int(batch.index[0])
        task: Any = pl_module
        data: Any = trainer.datamodule  # type: ignore[attr-defined]
        source = data.source("val")
        rgb = shown_image(source.read(index), target, task.representation)
        truth, labels = (_smaller(side_by_side(x.cpu().numpy())) for x in (target, outputs[0]))
        panel = prediction_panel(_smaller(rgb), truth, labels, task.class_names)
        tag = f"val_images/{source.name(index).replace('/', '_')}"
        writer.add_image(tag, panel, _step(trainer), dataformats="HWC")


class ValidationConfusion(Callback):
    """Log per-class scores to TensorBoard after every validation.

    * ``val_iou/<class>``, of shapes ``val_accuracy/<class>``: of the classes that occur.
    * ``val/confusion``: the confusion matrix, in percent of the true class.

    They are logged at the same steps as ``val/miou``. Only the first process draws, and only with a
    TensorBoard logger.
    """

    def on_validation_end(  # noqa: D102 - a hook of Lightning; the scores are there now
        self, trainer: lightning.Trainer, pl_module: lightning.LightningModule
    ) -> None:
        writer = _writer(trainer)
        if writer is None:
            return
        task: Any = pl_module
        segmentation = task.kind == "segmentation"
        if segmentation:
            matrix, name = task.matrices.pixels, "val_iou"
            values = segmentation_scores(matrix, task.absent_class).iou
        else:
            matrix, name = task.matrices, "val_accuracy"
            values = classification_scores(matrix).of_class
        step = _step(trainer)
        for class_name, value in zip(task.class_names[int(segmentation) :], values, strict=True):
            if not np.isnan(value):
                writer.add_scalar(f"{name}/{class_name}", value, step)
        picture = confusion_picture(matrix, task.class_names, unknown=segmentation)
        writer.add_image("val/confusion", picture, step, dataformats="HWC")


class TrainingSpeed(Callback):
    """Logs ``speed/images_per_s`` once an epoch.

    Network inputs (tangent images, crops, …) that all processes trained on per second of the
    epoch, without its validation.
    """

    def __init__(self) -> None:
        self._since, self._paused, self._images = 0.0, 0.0, 0

    def on_train_epoch_start(  # noqa: D102 - a hook of Lightning
        self, trainer: lightning.Trainer, pl_module: lightning.LightningModule
    ) -> None:
        self._since, self._images = _now(pl_module), 0

    on_train_start = on_train_epoch_start  # a resumed epoch has no other

    def on_train_batch_end(  # noqa: D102 - a hook of Lightning
        self,
        trainer: lightning.Trainer,
        pl_module: lightning.LightningModule,
        outputs: Any,
        batch: Any,
        batch_idx: int,
    ) -> None:
        self._images += batch.images.shape[0] * batch.images.shape[1]

    def on_validation_start(  # noqa: D102 - a hook of Lightning
        self, trainer: lightning.Trainer, pl_module: lightning.LightningModule
    ) -> None:
        self._paused = _now(pl_module)

    def on_validation_end(  # noqa: D102 - a hook of Lightning
        self, trainer: lightning.Trainer, pl_module: lightning.LightningModule
    ) -> None:
        self._since += _now(pl_module) - self._paused

    def on_train_epoch_end(  # noqa: D102 - a hook of Lightning
        self, trainer: lightning.Trainer, pl_module: lightning.LightningModule
    ) -> None:
        if trainer.is_global_zero and self._images:
            seconds = _now(pl_module) - self._since
            # Every process has as many images.
            speed = self._images * trainer.world_size / seconds
            pl_module.log("speed/images_per_s", speed, rank_zero_only=True)


def _smaller(image: NDArray[Any]) -> NDArray[Any]:
    """Downsample to at most `_MOST_ROWS` rows: labels by striding, colours by averaging."""
    step = -(-image.shape[0] // _MOST_ROWS)
    labels = image[step // 2 :: step, step // 2 :: step]
    if image.ndim == _PANORAMA_DIMENSIONS or step == 1:
        return labels
    rows, columns = labels.shape[:2]
    colors: NDArray[Any] = cv2.resize(image, (columns, rows), interpolation=cv2.INTER_AREA)
    return colors


def _writer(trainer: lightning.Trainer) -> Any:
    """TensorBoard's writer in the first process, otherwise None."""
    if trainer.sanity_checking or not trainer.is_global_zero:
        return None
    found = (x.experiment for x in trainer.loggers if isinstance(x, TensorBoardLogger))
    return next(found, None)


def _step(trainer: lightning.Trainer) -> int:
    """Step at which Lightning logs a validation (one less than `global_step` then)."""
    return trainer.fit_loop.epoch_loop._batches_that_stepped


def _now(module: lightning.LightningModule) -> float:
    """Seconds, after synchronizing the device."""
    if module.device.type == "cuda":
        torch.cuda.synchronize(module.device)
    return time.perf_counter()
