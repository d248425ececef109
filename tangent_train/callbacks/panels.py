"""Write pictures of test predictions."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import torch
from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import Callback

from tangent_train.errors import at_least
from tangent_train.files import write_bytes
from tangent_train.heads.pictures import evenly_spread
from tangent_train.results.html import EncodedImage


class PredictionPanels(Callback):
    """Writes pictures of test predictions, see `Task.picture`.

    Args:
        folder: Output folder.
        count: Number of images, spread over the test split.

    Attributes:
        images: Compressed images for the report's viewer; after the test those of all processes,
            in the order of the split.

    Raises:
        SettingError: `count` is negative.
    """

    def __init__(self, folder: Path | str, count: int = 6) -> None:
        self.folder = Path(folder)
        self.count = at_least("panels", count, 0)
        self.images: list[EncodedImage] = []
        self._encoded: dict[int, EncodedImage] = {}

    def on_test_batch_end(  # noqa: D102 - a hook of Lightning
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, *_: int
    ) -> None:
        task: Any = pl_module
        source: Any = trainer.datamodule.dataset("test")  # type: ignore[attr-defined]
        chosen = evenly_spread(self.count, len(source))
        predictions = zip(batch.index.tolist(), task.true_labels(batch), outputs, strict=True)
        for index, target, prediction in predictions:
            if index in chosen:
                self._write_panel(source, index, task, target, prediction)

    def _write_panel(self, source: Any, index: int, task: Any, *labels: Any) -> None:
        name, image = source.name(index), source.read(index)
        panel = task.picture(image, *labels)
        if panel is None:
            return
        encoded = cv2.imencode(".png", cv2.cvtColor(panel, cv2.COLOR_RGB2BGR))[1]
        file = f"{index}_{name.replace('/', '_')}.png"  # with the index, the name is unique
        write_bytes(self.folder / file, encoded.tobytes())
        self._encoded[index] = task.report_image(name, image, *labels)

    def on_test_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Gather the images of all processes."""
        parts = [self._encoded]
        if torch.distributed.is_available() and torch.distributed.is_initialized():
            parts *= trainer.world_size
            torch.distributed.all_gather_object(parts, self._encoded)
        gathered = {index: image for part in parts for index, image in part.items()}
        self.images = [gathered[index] for index in sorted(gathered)]
