"""Print the progress of a run: as a bar on a terminal, as lines elsewhere."""

from __future__ import annotations

import time
from datetime import timedelta
from typing import Any

from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import RichProgressBar
from rich import get_console

from tangent_train.progress import PlainLines


class ProgressBar(RichProgressBar):
    """Lightning's bar with rate and time left, without the logger's version.

    If the output is not a terminal, a line is printed after every epoch, and after every minute
    without a line.
    """

    def __init__(self) -> None:
        super().__init__(leave=False)
        if not get_console().is_terminal:
            self.disable()
        self._lines = PlainLines()
        self._begun = 0.0
        self._epochs = 0

    def get_metrics(self, trainer: Trainer, pl_module: LightningModule) -> dict[str, Any]:
        """Return the metrics that are printed after the bar."""
        metrics = super().get_metrics(trainer, pl_module)
        return {name: value for name, value in metrics.items() if name != "v_num"}

    def on_train_start(self, *args: Any) -> None:
        """Start to time the epochs."""
        super().on_train_start(*args)
        self._begun = time.monotonic()

    def on_train_batch_end(self, trainer: Any, *args: Any) -> None:
        """Print a line per minute."""
        super().on_train_batch_end(trainer, *args)
        self._print(f"Epoch {trainer.current_epoch + 1}", args[3], trainer.num_training_batches)

    def on_validation_batch_end(self, trainer: Any, *args: Any) -> None:
        """Print a line per minute."""
        super().on_validation_batch_end(trainer, *args)
        self._print("Validation", args[3], trainer.num_val_batches[0])

    def on_test_batch_end(self, trainer: Any, *args: Any) -> None:
        """Print a line per minute."""
        super().on_test_batch_end(trainer, *args)
        self._print("Test", args[3], trainer.num_test_batches[0])

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Print a line with the metrics and the time left."""
        super().on_train_epoch_end(trainer, pl_module)
        self._epochs += 1
        done, last = trainer.current_epoch + 1, trainer.max_epochs or -1
        parts = [f"Epoch {done} of {last}" if last > 0 else f"Epoch {done}"]
        parts += [f"{k} {value:.3f}" for k, value in self.get_metrics(trainer, pl_module).items()]
        if last > done:
            seconds = (time.monotonic() - self._begun) / self._epochs * (last - done)
            parts.append(f"{timedelta(seconds=round(seconds))} left")
        if trainer.is_global_zero:
            self._lines.print(", ".join(parts), at_once=True)

    def _print(self, stage: str, index: int, total: float) -> None:
        if self.trainer.is_global_zero:
            self._lines.print(f"{stage}: {index + 1} of {total} steps")
