"""Log pictures of validation predictions."""

from __future__ import annotations

from typing import Any

from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import Callback
from lightning.pytorch.loggers import Logger, MLFlowLogger, TensorBoardLogger, WandbLogger

from tangent_train.errors import at_least
from tangent_train.heads.pictures import evenly_spread

_MOST_ROWS = 256
"""Larger images are reduced: a log contains the pictures of all validations."""


class ValidationPictures(Callback):
    """Logs pictures of validation images after every validation, see `Task.picture`.

    Their names are ``val_images/<name>``. The images are the same in every validation, spread over
    the images of the first process.

    Args:
        count: Number of images.

    Raises:
        SettingError: `count` is negative.
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
        chosen = evenly_spread(self.count, int(trainer.num_val_batches[dataloader_idx]))
        is_logged = trainer.is_global_zero and not trainer.sanity_checking and trainer.loggers
        if not is_logged or batch_idx not in chosen:
            return
        task: Any = pl_module
        data: Any = trainer.datamodule  # type: ignore[attr-defined]
        source, index = data.dataset("val"), int(batch.index[0])
        labels = task.true_labels(batch)[0], outputs[0]
        panel = task.picture(source.read(index), *labels, most_rows=_MOST_ROWS)
        if panel is None:
            return
        tag = f"val_images/{source.name(index).replace('/', '_')}"
        # The step at which Lightning logs the validation, one less than `global_step`.
        step = trainer.fit_loop.epoch_loop._batches_that_stepped
        for logger in trainer.loggers:
            log_image(logger, tag, panel, step)


def log_image(logger: Logger, name: str, image: Any, step: int) -> None:
    """Log an image to a logger that shows images; do nothing for others.

    Args:
        logger: Logger of any class.
        name: Name of the image.
        image: uint8 RGB ``(H, W, 3)``.
        step: Number of optimizer steps.
    """
    if isinstance(logger, TensorBoardLogger):
        logger.experiment.add_image(name, image, step, dataformats="HWC")
    elif isinstance(logger, WandbLogger):
        logger.log_image(name, [image], step)
    elif isinstance(logger, MLFlowLogger):
        logger.experiment.log_image(logger.run_id, image, key=name, step=step)
