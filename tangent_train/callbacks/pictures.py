"""Draw validation images in the loggers, and test images in files and for the report."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import Callback
from lightning.pytorch.loggers import Logger, MLFlowLogger, TensorBoardLogger, WandbLogger
from torch import Tensor

from tangent_train.console import print_text
from tangent_train.errors import first_line
from tangent_train.heads.base import RGB, PredictedImage
from tangent_train.heads.pictures import evenly_spread, shown_arrays
from tangent_train.io.pixel_files import write_pixels
from tangent_train.results.page import EncodedImage, encode_image

_MOST_ROWS = 256
"""Larger images are reduced in logs, which contain the pictures of all validations."""


class Pictures(Callback):
    """Draws predictions of images that are spread over a split, see `Head.panel`.

    Validation images are logged as ``val_images/<name>``, the same ones after every validation.

    Args:
        folder: Output folder of the pictures of test images.
        test: Number of test images.
        validation: Number of validation images, of the first process.
    """

    def __init__(self, folder: Path | str, test: int = 6, validation: int = 4) -> None:
        self.folder = Path(folder)
        self.test, self.validation = test, validation
        self._encoded: dict[int, tuple[float, EncodedImage]] = {}  # with minus the errors

    def on_validation_batch_end(  # noqa: D102 - a hook of Lightning
        self,
        trainer: Trainer,
        pl_module: LightningModule,
        outputs: Any,
        batch: Any,
        batch_idx: int,
        dataloader_idx: int = 0,
    ) -> None:
        chosen = evenly_spread(self.validation, int(trainer.num_val_batches[dataloader_idx]))
        is_logged = trainer.is_global_zero and not trainer.sanity_checking and trainer.loggers
        if not is_logged or batch_idx not in chosen:
            return
        source, index = _dataset(trainer, "val"), int(batch.index[0])
        panel = _panel(pl_module, source.read(index), batch.labels[0], outputs[0], _MOST_ROWS)
        tag = f"val_images/{source.name(index).replace('/', '_')}"
        # The step at which Lightning logs the validation, one less than `global_step`.
        step = trainer.fit_loop.epoch_loop._batches_that_stepped
        for logger in trainer.loggers if panel is not None else ():
            try:
                log_image(logger, tag, panel, step)
            except Exception as error:
                print_text(f"{tag} is not logged: {first_line(error)}", error=True)

    def on_test_batch_start(  # noqa: D102 - a hook of Lightning
        self, trainer: Trainer, pl_module: LightningModule, batch: Any, *_: int
    ) -> None:
        chosen = evenly_spread(self.test, len(_dataset(trainer, "test")))
        task: Any = pl_module
        task.confidences = [] if np.isin(batch.index.tolist(), chosen).any() else None

    def on_test_batch_end(  # noqa: D102 - a hook of Lightning
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, *_: int
    ) -> None:
        confidences = getattr(pl_module, "confidences", None) or [None] * len(outputs)
        for result in zip(batch.index.tolist(), confidences, batch.labels, outputs, strict=True):
            self.draw(pl_module, _dataset(trainer, "test"), *result)

    def draw(self, task: Any, source: Any, index: int, confidence: Any, *labels: Any) -> None:
        """Draw a test image, if it is one of the chosen ones.

        Args:
            task: Task with the head and the representation.
            source: Samples of the test split.
            index: Place of the image.
            confidence: Its confidences, or None.
            *labels: Its true labels and its prediction, see `Task.evaluate`.
        """
        name = source.name(index)
        is_chosen = index in evenly_spread(self.test, len(source))
        image = source.read(index) if is_chosen else None
        panel = None if image is None else _panel(task, image, *labels)
        if panel is not None:
            file = f"{index}_{name.replace('/', '_')}.png"  # unique, by the index
            write_pixels(self.folder / file, panel)
            self._encoded[index] = _encoded(task, name, image, confidence, *labels)

    def on_test_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Gather the images of all processes."""
        if trainer.world_size > 1:
            parts = [self._encoded] * trainer.world_size
            torch.distributed.all_gather_object(parts, self._encoded)
            self._encoded = {index: entry for part in parts for index, entry in part.items()}

    @property
    def images(self) -> list[EncodedImage]:
        """Compressed test images, the worst first; after the test those of all processes."""
        return [image for _, image in sorted(self._encoded.values())]


def _panel(
    task: Any, image: Any, target: Tensor, prediction: Tensor, most_rows: int | None = None
) -> RGB | None:
    """Draw one prediction; None if the head draws no pictures.

    Args:
        task: Task with the head.
        image: `Panorama` or `Photo`.
        target: True labels of the image.
        prediction: Prediction for the image, one item of the result of `Task.evaluate`.
        most_rows: Largest number of rows of the image in the picture; None for all.
    """
    if not target.ndim:
        return None
    truth = task.head.truth(target)
    panel: RGB | None = task.head.panel(
        *shown_arrays(
            image, truth, prediction, task.representation, most_rows, unknown=task.head.unknown
        )
    )
    return panel


def _encoded(
    task: Any, name: str, image: Any, confidence: Any, target: Tensor, prediction: Tensor
) -> tuple[float, EncodedImage]:
    """Return minus the error of an image, and the image for the report's viewer, see `_panel`."""
    truth, count = task.head.truth(target), len(task.head.class_names)
    given = image, truth, prediction, task.representation
    rgb, true, shown = shown_arrays(*given, cut=False, unknown=task.head.unknown)
    maps = task.head.report_maps(PredictedImage(image, shown))
    maps["truth"] = task.head.report_maps(PredictedImage(image, true))["prediction"]
    error, note = task.head.error(prediction, truth)
    how: dict[str, Any] = {"sphere": target.ndim == 2, "note": note, "confidence": confidence}
    return -error, encode_image(name, rgb, count, **maps, **how)


def _dataset(trainer: Trainer, split: str) -> Any:
    return trainer.datamodule.dataset(split)  # type: ignore[attr-defined]


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
