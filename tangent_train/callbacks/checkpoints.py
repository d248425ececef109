"""Checkpoints: their content, when they are written, and exact resuming."""

from __future__ import annotations

import shlex
import signal
import threading
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal

import torch
from lightning import LightningModule, Trainer
from lightning.fabric.plugins import TorchCheckpointIO
from lightning.pytorch.callbacks import Callback, Checkpoint, ModelCheckpoint, Timer
from lightning.pytorch.utilities.exceptions import SIGTERMException

from tangent_train.console import print_text
from tangent_train.errors import at_least
from tangent_train.files import atomic_path


class AtomicCheckpointIO(TorchCheckpointIO):
    """Write beside the old checkpoint and rename.

    Lightning's own writes to the system's temporary folder, often another disk: moving from there
    is a copy that a kill cuts off.
    """

    def save_checkpoint(
        self, checkpoint: dict[str, Any], path: str | Path, storage_options: Any = None
    ) -> None:
        """Save atomically.

        Args:
            checkpoint: Tensors and plain values.
            path: The file.
            storage_options: Not used.
        """
        with atomic_path(Path(path)) as temporary:
            torch.save(checkpoint, temporary)

    def remove_checkpoint(self, path: str | Path) -> None:
        """Remove a file. Lightning's own would remove a whole folder."""
        Path(path).unlink(missing_ok=True)


class CheckpointContents(Callback):
    """Store in every checkpoint what later commands need, the random state and an early end.

    Args:
        contents: Nested dicts and lists of plain values, by name.
    """

    def __init__(self, contents: dict[str, Any]) -> None:
        self.contents = contents | {"tangent_train_version": version("tangent-train")}
        self._random_states: list[dict[str, Any]] | None = None
        self._stopped = False

    def on_save_checkpoint(
        self, trainer: Trainer, pl_module: LightningModule, checkpoint: dict[str, Any]
    ) -> None:
        """Add the contents, and under ``random`` the generators of every process."""
        checkpoint.update(self.contents)
        # A resumed run may get more time.
        out_of_time = any(isinstance(one, Timer) for one in trainer.callbacks)  # type: ignore[attr-defined]
        checkpoint["stopped"] = trainer.should_stop and not out_of_time
        # Data has generators of its own, see `sample_rng`.
        cuda = [torch.cuda.get_rng_state()] if torch.cuda.is_available() else []
        state = {"cpu": torch.get_rng_state(), "cuda": cuda}
        checkpoint["random"] = [state] * trainer.world_size
        if trainer.world_size > 1:
            torch.distributed.all_gather_object(checkpoint["random"], state)

    def on_load_checkpoint(
        self, trainer: Trainer, pl_module: LightningModule, checkpoint: dict[str, Any]
    ) -> None:
        """Take the generators' states, and whether a callback had ended the training."""
        self._random_states = checkpoint.get("random")
        self._stopped = checkpoint.get("stopped") is True

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Restore them: the random state (dropout) continues, on as many processes as before."""
        trainer.should_stop |= self._stopped
        states = self._random_states
        if states is not None and len(states) == trainer.world_size:
            state = states[trainer.global_rank]
            torch.set_rng_state(state["cpu"])
            if torch.cuda.is_available() and state["cuda"]:
                torch.cuda.set_rng_state(state["cuda"][0])


class LastCheckpoint(Checkpoint):
    """Keep ``last.ckpt`` at the newest state from which training can resume.

    Written before the first step, after every epoch, every so many steps, and on SIGTERM (what a
    cluster sends before it kills): after the current step, or at the end of the epoch once its
    steps are done. A run can always be resumed exactly; an interrupted run prints the command.

    Args:
        folder: The checkpoints' folder of a run.
        every_n_steps: Optimizer steps between checkpoints within an epoch; None for none.
        typed: Settings that the resuming command needs besides the folder.

    Attributes:
        has_begun: Whether training has begun, with everything restored.

    Raises:
        SettingError: Fewer than one step.
    """

    def __init__(
        self, folder: Path | str, every_n_steps: int | None = None, typed: Sequence[str] = ()
    ) -> None:
        if every_n_steps is not None:
            at_least("checkpoint_every_n_steps", every_n_steps, 1)
        self.path = Path(folder) / "last.ckpt"
        self.every_n_steps = every_n_steps
        self.typed = typed
        self.has_begun = False
        self._told_to_end = False
        self._processes: Any = None

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Save the untrained state of a new run, and listen for SIGTERM.

        Not by Lightning's handler: it communicates with the other processes inside the signal
        handler, which can deadlock.
        """

        def listen(number: int, _: object) -> None:
            if trainer.strategy.launcher is not None:
                trainer.strategy.launcher.kill(number)
            self._told_to_end = True

        self.has_begun = True
        self._told_to_end = False
        if trainer.world_size > 1:  # a group of its own on the CPU: no waiting for a GPU
            self._processes = torch.distributed.new_group(backend="gloo")
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGTERM, listen)  # Lightning puts back what there was before
        if trainer.global_step == 0:
            trainer.save_checkpoint(self.path, weights_only=False)

    def on_train_batch_end(  # noqa: D102 - a hook of Lightning
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        stepped = (batch_idx + 1) % trainer.accumulate_grad_batches == 0
        ends_epoch = batch_idx + 1 == trainer.num_training_batches  # saved in a moment
        if not stepped or ends_epoch:
            return
        due = bool(self.every_n_steps) and trainer.global_step % (self.every_n_steps or 1) == 0
        ending = self._any_told_to_end(trainer)
        if due or ending:
            trainer.save_checkpoint(self.path, weights_only=False)
        if ending:
            raise SIGTERMException

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Save the state after every epoch."""
        trainer.save_checkpoint(self.path, weights_only=False)
        if self._any_told_to_end(trainer):
            raise SIGTERMException

    def on_exception(
        self, trainer: Trainer, pl_module: LightningModule, exception: BaseException
    ) -> None:
        """Print how to resume the run."""
        if trainer.is_global_zero and self.has_begun and self.path.is_file():
            saved = "here" if isinstance(exception, SIGTERMException) else "the last checkpoint"
            command = shlex.join([f"resume={self.path.parent.parent}", *self.typed])
            text = f"{self.path} has all up to {saved}; resume with\n  tangent-train {command}"
            print_text(text, error=True)

    def _any_told_to_end(self, trainer: Trainer) -> bool:
        """Whether some process got SIGTERM: all end after the same step."""
        told = torch.tensor(int(self._told_to_end))
        if trainer.world_size > 1:
            torch.distributed.all_reduce(told, group=self._processes)
        return bool(told)


class BestCheckpoint(ModelCheckpoint):
    """Keep ``best.ckpt``, the epoch with the best validation score; none without validation.

    Args:
        folder: Output folder, of a resumed run whose folder was moved too.
        monitor: The score.
        mode: ``max`` or ``min``: the better value.
    """

    def __init__(
        self, folder: Path | str, monitor: str = "val/miou", mode: Literal["max", "min"] = "max"
    ) -> None:
        super().__init__(
            dirpath=folder,
            filename="best",
            monitor=monitor,
            mode=mode,
            auto_insert_metric_name=False,
            enable_version_counter=False,
            save_on_train_epoch_end=False,
        )

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore the best score; the path of its file is not taken from a file."""
        score = state_dict["best_model_score"]
        if score is None:
            return
        path = str(Path(self.dirpath or "") / "best.ckpt")
        score = torch.as_tensor(score)
        self.best_model_score = self.kth_value = self.current_score = score
        self.best_model_path = self.kth_best_model_path = path
        self.best_k_models = {path: score}
