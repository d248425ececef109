"""Pictures of the test."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import Callback

from tangent_train.errors import at_least
from tangent_train.files import write_bytes
from tangent_train.metrics.segmentation import segmentation_scores
from tangent_train.results.html import EncodedImage, encode_image
from tangent_train.results.pictures import evenly_spread, prediction_panel, shown_arrays
from tangent_train.results.tables import percent

_PANORAMA_DIMENSIONS = 2


class PredictionPanels(Callback):
    """Writes pictures of test panoramas or photos: input, ground truth, prediction, error.

    Args:
        folder: Output folder.
        count: Number of images, spread over the test split.

    Attributes:
        images: The same, compressed, for the viewer of the report; after the test those of all
            processes, in the order of the split.

    Raises:
        SettingError: Less than 0.
    """

    def __init__(self, folder: Path | str, count: int = 6) -> None:
        self.folder = Path(folder)
        self.count = at_least("panels", count, 0)
        self.images: list[EncodedImage] = []
        self._encoded: dict[int, EncodedImage] = {}

    def on_test_batch_end(  # noqa: D102 - a hook of Lightning
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, *_: int
    ) -> None:
        source: Any = trainer.datamodule.source("test")  # type: ignore[attr-defined]
        chosen = evenly_spread(self.count, len(source))
        for index, prediction, target in zip(
            batch.index.tolist(), outputs, batch.target, strict=True
        ):
            if index in chosen:
                self._show(source, index, target, prediction, pl_module)

    def _show(self, source: Any, index: int, target: Any, prediction: Any, task: Any) -> None:
        name, classes = source.name(index), len(task.class_names)
        image, representation = source.read(index), task.representation
        rgb, truth, labels = shown_arrays(image, target, prediction, representation)
        panel = prediction_panel(rgb, truth, labels, task.class_names)
        encoded = cv2.imencode(".png", cv2.cvtColor(panel, cv2.COLOR_RGB2BGR))[1]
        file = f"{index}_{name.replace('/', '_')}.png"  # other names may have "_" in them
        write_bytes(self.folder / file, encoded.tobytes())
        pairs = truth.astype(np.int64).ravel() * classes + labels.ravel()
        counts = np.bincount(pairs, minlength=classes**2).reshape(classes, classes)
        note = f"mIoU {percent(segmentation_scores(counts).miou)}\u00a0%" if truth.any() else ""
        sphere = target.ndim == _PANORAMA_DIMENSIONS
        self._encoded[index] = encode_image(
            name, rgb, classes, prediction=labels, truth=truth, sphere=sphere, note=note
        )

    def on_test_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Gather the images of all processes."""
        parts = [self._encoded]
        if torch.distributed.is_available() and torch.distributed.is_initialized():
            parts *= trainer.world_size
            torch.distributed.all_gather_object(parts, self._encoded)
        together = {index: image for part in parts for index, image in part.items()}
        self.images = [together[index] for index in sorted(together)]
