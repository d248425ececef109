"""What happens around training: pictures, the config in the checkpoint, the way on."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import lightning
import numpy as np
from lightning.pytorch.callbacks import Callback, Checkpoint, ModelCheckpoint, RichProgressBar
from rich.console import Console

from tangent_train.files import write_bytes
from tangent_train.tasks.pictures import prediction_panel

__all__ = [
    "CheckpointConfig",
    "LastCheckpoint",
    "PredictionPanels",
    "ProgressBar",
    "best_checkpoint",
]


class CheckpointConfig(Callback):
    """Puts the config into every checkpoint, as plain values.

    Args:
        config: Nested dicts and lists of plain values.
    """

    def __init__(self, config: dict[str, Any]) -> None:
        self.config = config

    def on_save_checkpoint(
        self,
        trainer: lightning.Trainer,
        pl_module: lightning.LightningModule,
        checkpoint: dict[str, Any],
    ) -> None:
        """Add the config under ``config``."""
        checkpoint["config"] = self.config


class PredictionPanels(Callback):
    """Writes pictures of test panoramas: input, truth, prediction, error.

    Args:
        folder: Where to.
        count: How many panoramas, spread over the test split.
    """

    def __init__(self, folder: Path | str, count: int = 6) -> None:
        self.folder = Path(folder)
        self.count = count

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
                panel = prediction_panel(
                    source.read(index).rgb,
                    target.cpu().numpy(),
                    prediction.cpu().numpy(),
                    pl_module.class_names,  # type: ignore[arg-type]
                )
                encoded = cv2.imencode(".png", cv2.cvtColor(panel, cv2.COLOR_RGB2BGR))[1]
                name = source.name(index).replace("/", "_")
                write_bytes(self.folder / f"{name}.png", encoded.tobytes())


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


class LastCheckpoint(Checkpoint):
    """Keeps ``last.ckpt`` at the newest state training can go on from: the end of an epoch.

    The first one is written before the first step, so that an interrupted run can always be
    resumed; the way to do that is said when it is interrupted.

    Args:
        folder: Where to; the checkpoints' folder of a run.
    """

    def __init__(self, folder: Path | str) -> None:
        self.path = Path(folder) / "last.ckpt"

    def on_train_start(
        self, trainer: lightning.Trainer, pl_module: lightning.LightningModule
    ) -> None:
        """Save the untrained state of a new run."""
        if trainer.global_step == 0:
            trainer.save_checkpoint(self.path, weights_only=False)

    def on_train_epoch_end(
        self, trainer: lightning.Trainer, pl_module: lightning.LightningModule
    ) -> None:
        """Save the state after every epoch."""
        trainer.save_checkpoint(self.path, weights_only=False)

    def on_exception(
        self,
        trainer: lightning.Trainer,
        pl_module: lightning.LightningModule,
        exception: BaseException,
    ) -> None:
        """Say how to go on after Ctrl-C; an error says for itself what to do."""
        interrupted = isinstance(exception, KeyboardInterrupt) and trainer.is_global_zero
        if interrupted and self.path.exists():
            run_folder = self.path.parent.parent
            Console(stderr=True).print(
                f"Interrupted. All finished epochs are in {self.path}; go on with\n"
                f"  tangent-train resume={run_folder}",
                soft_wrap=True,
                highlight=False,
            )


def best_checkpoint(folder: Path | str, monitor: str = "val/miou") -> ModelCheckpoint:
    """Keeps ``best.ckpt``, the epoch with the highest figure of the validation split.

    Args:
        folder: Where to.
        monitor: The figure.
    """
    return ModelCheckpoint(
        dirpath=folder,
        filename="best",
        monitor=monitor,
        mode="max",
        auto_insert_metric_name=False,
        enable_version_counter=False,
    )
