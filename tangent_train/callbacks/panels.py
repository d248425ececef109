"""What happens around training: pictures and progress."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import lightning
import numpy as np
import torch
from lightning.pytorch.callbacks import Callback, RichProgressBar

from tangent_train.errors import SettingError
from tangent_train.files import write_bytes
from tangent_train.results.html.evaluation import image_note
from tangent_train.results.html.images import EncodedImage, ViewerImage, encode_image
from tangent_train.results.pictures import prediction_panel, shown_image, side_by_side

__all__ = ["PredictionPanels", "ProgressBar"]

_PANORAMA_DIMENSIONS = 2


class PredictionPanels(Callback):
    """Writes pictures of test panoramas or photos: input, truth, prediction, error.

    Args:
        folder: Where to.
        count: How many of them, spread over the test split.

    Attributes:
        images: The same, compressed, for the viewer of the report; after the test those of all
            processes, in the order of the split.
    """

    def __init__(self, folder: Path | str, count: int = 6) -> None:
        if count < 0:
            raise SettingError("panels", found=count, expected="0 or more")
        self.folder = Path(folder)
        self.count = count
        self.images: list[EncodedImage] = []
        self._encoded: dict[int, EncodedImage] = {}

    def on_test_start(
        self, trainer: lightning.Trainer, pl_module: lightning.LightningModule
    ) -> None:
        """Start anew."""
        self._encoded = {}

    def on_test_batch_end(  # noqa: D102 - a hook of Lightning
        self,
        trainer: lightning.Trainer,
        pl_module: lightning.LightningModule,
        outputs: Any,
        batch: Any,
        batch_idx: int,
        dataloader_idx: int = 0,
    ) -> None:
        source: Any = trainer.datamodule.source("test")  # type: ignore[attr-defined]
        chosen = np.linspace(0, len(source) - 1, min(self.count, len(source))).round()
        for index, prediction, target in zip(
            batch.index.tolist(), outputs, batch.target, strict=True
        ):
            if index in chosen:
                image: Any = source.read(index)
                shown = (
                    shown_image(image, target, pl_module.representation),
                    side_by_side(target.cpu().numpy()),
                    side_by_side(prediction.cpu().numpy()),
                )
                class_names: Any = pl_module.class_names
                panel = prediction_panel(*shown, class_names)
                encoded = cv2.imencode(".png", cv2.cvtColor(panel, cv2.COLOR_RGB2BGR))[1]
                name = source.name(index).replace("/", "_")
                write_bytes(self.folder / f"{name}.png", encoded.tobytes())
                rgb, truth, labels = shown
                viewed = ViewerImage(
                    source.name(index),
                    rgb,
                    labels,
                    truth,
                    sphere=target.ndim == _PANORAMA_DIMENSIONS,
                    note=image_note(truth, labels, len(class_names)),
                )
                self._encoded[index] = encode_image(viewed, len(class_names))

    def on_test_end(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Bring together what the processes have."""
        parts = [self._encoded]
        if torch.distributed.is_available() and torch.distributed.is_initialized():
            parts *= trainer.world_size
            torch.distributed.all_gather_object(parts, self._encoded)
        together = {index: image for part in parts for index, image in part.items()}
        self.images = [together[index] for index in sorted(together)]


class ProgressBar(RichProgressBar):
    """Lightning's bar with rate and time left, without the logger's version."""

    def __init__(self) -> None:
        super().__init__(leave=False)

    def get_metrics(
        self, trainer: lightning.Trainer, pl_module: lightning.LightningModule
    ) -> dict[str, Any]:
        """The figures behind the bar."""
        figures = dict(super().get_metrics(trainer, pl_module))
        figures.pop("v_num", None)
        return figures
