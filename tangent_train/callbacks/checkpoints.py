"""Write checkpoints, and resume from them exactly."""

from __future__ import annotations

import os
import shlex
import signal
import threading
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal

import torch
from lightning import LightningModule, Trainer
from lightning.fabric.plugins import TorchCheckpointIO
from lightning.pytorch.callbacks import Callback, Checkpoint, ModelCheckpoint, Timer
from lightning.pytorch.utilities.exceptions import SIGTERMException

from tangent_train.console import print_text
from tangent_train.files import atomic_path, load_plain, quoted


class AtomicCheckpointIO(TorchCheckpointIO):
    """Writes a checkpoint under a temporary name in its folder and renames it.

    Lightning's class writes to the system's temporary folder, often on another disk. Moving the
    file from there is a copy, which is incomplete if the process is killed.
    """

    def save_checkpoint(
        self, checkpoint: dict[str, Any], path: str | Path, storage_options: Any = None
    ) -> None:
        """Save atomically.

        Args:
            checkpoint: Tensors and plain values.
            path: File to write.
            storage_options: Ignored.
        """
        with atomic_path(Path(path)) as temporary:
            torch.save(checkpoint, temporary)

    def load_checkpoint(self, path: str | Path, *_: Any, **__: Any) -> dict[str, Any]:
        """Load tensors and plain values, which callbacks may have stored too."""
        content: dict[str, Any] = load_plain(Path(path), "a checkpoint of a run")
        return content


class CheckpointContents(Callback):
    """Stores plain values, the random state and an early end of the training in checkpoints.

    Args:
        contents: Values by name that later commands need: nested dicts and lists of plain values.
    """

    def __init__(self, contents: dict[str, Any]) -> None:
        self.contents = contents | {"tangent_train_version": version("tangent-train")}
        self._restored: dict[str, Any] = {}

    def on_save_checkpoint(
        self, trainer: Trainer, pl_module: LightningModule, checkpoint: dict[str, Any]
    ) -> None:
        """Add the contents, and under ``random`` the generators of every process."""
        checkpoint.update(self.contents)
        # A resumed run may have more time.
        timers: Any = [c for c in trainer.callbacks if isinstance(c, Timer)]  # type: ignore[attr-defined]
        out_of_time = any((timer.time_remaining() or 0) <= 0 for timer in timers)
        checkpoint["stopped"] = trainer.should_stop and not out_of_time
        # Samples have separate generators, see `sample_rng`.
        cuda = [torch.cuda.get_rng_state()] if torch.cuda.is_available() else []
        state = {"cpu": torch.get_rng_state(), "cuda": cuda}
        checkpoint["random"] = [state] * trainer.world_size
        if trainer.world_size > 1:
            torch.distributed.all_gather_object(checkpoint["random"], state)

    def on_load_checkpoint(
        self, trainer: Trainer, pl_module: LightningModule, checkpoint: dict[str, Any]
    ) -> None:
        """Read the states of the generators, and if a callback had ended the training."""
        self._restored = {name: checkpoint.get(name) for name in ("random", "stopped")}

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Restore the random state (dropout), if the number of processes is the same."""
        trainer.should_stop |= bool(self._restored.get("stopped"))
        states = self._restored.get("random") or ()
        if len(states) == trainer.world_size:
            state = states[trainer.global_rank]
            torch.set_rng_state(state["cpu"])
            if torch.cuda.is_available() and state["cuda"]:
                torch.cuda.set_rng_state(state["cuda"][0])


class LastCheckpoint(Checkpoint):
    """Writes ``last.ckpt``, the newest state from which training can resume.

    It is written before the first step, after every epoch, after every `every_n_steps` steps, and
    on SIGTERM, which a cluster sends before it kills a process, or SIGHUP, when a terminal closes:
    after the current step, or at the end of the epoch if its steps are done. An interrupted run
    prints the command that resumes it.

    Args:
        folder: Folder of the checkpoints of a run.
        every_n_steps: Number of optimizer steps between checkpoints within an epoch; None for
            checkpoints at the end of epochs only.
    """

    def __init__(self, folder: Path | str, every_n_steps: int | None = None) -> None:
        self.path = Path(folder) / "last.ckpt"
        self.every_n_steps = every_n_steps
        self._has_begun, self._signal = False, 0
        self._processes: Any = None

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Save the untrained state of a new run, and handle SIGTERM and SIGHUP.

        Lightning's handler is not used: it communicates with the other processes inside the signal
        handler, which can deadlock.
        """

        def handle(number: int, _: object) -> None:
            if trainer.strategy.launcher is not None:
                trainer.strategy.launcher.kill(number)
            self._signal = number

        self._has_begun = True
        if trainer.world_size > 1:  # a separate group on the CPU, which does not wait for a GPU
            self._processes = torch.distributed.new_group(backend="gloo")
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGTERM, handle)  # Lightning restores the previous handlers
            hangup = getattr(signal, "SIGHUP", signal.SIGTERM)  # not on Windows
            if signal.getsignal(hangup) != signal.SIG_IGN:  # as nohup leaves it
                signal.signal(hangup, handle)
        if trainer.global_step == 0:
            trainer.save_checkpoint(self.path, weights_only=False)

    def on_train_batch_end(  # noqa: D102 - a hook of Lightning
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        is_step = (batch_idx + 1) % trainer.accumulate_grad_batches == 0
        is_last = batch_idx + 1 == trainer.num_training_batches  # saved at the end of the epoch
        if is_step and not is_last:
            every = self.every_n_steps
            self._save(trainer, is_due=every is not None and trainer.global_step % every == 0)

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Save the state after every epoch."""
        self._save(trainer, is_due=True)

    def _save(self, trainer: Trainer, *, is_due: bool) -> None:
        """Save if it is due; if any process got a signal, save and end all after the same step."""
        ending = torch.tensor(self._signal)
        if trainer.world_size > 1:
            maximum = torch.distributed.ReduceOp.MAX
            torch.distributed.all_reduce(ending, maximum, group=self._processes)
        if is_due or ending:
            trainer.save_checkpoint(self.path, weights_only=False)
        if ending:
            raise SIGTERMException(int(ending))

    def on_exception(
        self, trainer: Trainer, pl_module: LightningModule, exception: BaseException
    ) -> None:
        """Print how to resume the run, unless an error of its first step would only be repeated."""
        if trainer.global_step == 0 and isinstance(exception, Exception):
            return
        if trainer.is_global_zero and self._has_begun and self.path.is_file():
            saved = "here" if isinstance(exception, SIGTERMException) else "the last checkpoint"
            command = f"tangent-train {shlex.quote(f'resume={quoted(self.path.parent.parent)}')}"
            if modules := os.environ.get("PYTHONPATH"):  # of classes of the user
                command = f"PYTHONPATH={shlex.quote(modules)} {command}"
            text = f"{self.path} contains all up to {saved}; resume with\n  {command}"
            print_text(text, error=True)


class BestCheckpoint(ModelCheckpoint):
    """Writes ``best.ckpt``, the epoch with the best validation score; no file without validation.

    Args:
        folder: Folder of the checkpoints, also of a resumed run whose folder was moved.
        monitor: Name of the score.
        mode: ``max`` if a larger score is better, ``min`` if a smaller one is.
    """

    def __init__(self, folder: Path | str, monitor: str, mode: Literal["max", "min"]) -> None:
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
        """Restore the best score, also if the folder was moved."""
        score = state_dict["best_model_score"]
        if score is not None:
            self.best_model_score = self.kth_value = self.current_score = score
            path = str(Path(self.dirpath or "") / "best.ckpt")
            self.best_model_path = self.kth_best_model_path = path
            self.best_k_models = {path: score}
