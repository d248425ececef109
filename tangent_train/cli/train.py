"""``tangent-train``: train a network, then evaluate it."""

from __future__ import annotations

import json
import logging
import os
import shutil
import signal
import sys
import warnings
from pathlib import Path

import lightning
from hydra.core.hydra_config import HydraConfig
from lightning.pytorch.callbacks import Callback, EMAWeightAveraging, WeightAveraging
from lightning.pytorch.utilities import rank_zero_only
from lightning.pytorch.utilities.exceptions import SIGTERMException

from tangent_train.callbacks.checkpoints import BestCheckpoint, LastCheckpoint
from tangent_train.cli import main
from tangent_train.cli.pretrained import load_pretrained, with_pretrained_network
from tangent_train.cli.processes import OBJECTIVE_FILE
from tangent_train.cli.run import Run, build
from tangent_train.config.settings import TrainSettings, refuse_typed
from tangent_train.console import print_text
from tangent_train.errors import SettingError
from tangent_train.files import atomic_path, load_plain, write_text

_EXPECTED_WARNINGS = (
    "Checkpoint directory .* exists and is not empty",  # a resumed run has checkpoints
    ".* your dataloader is not resumable",  # the data module stores where to continue
    "Total length of `list` across ranks is zero",  # a run may have no validation
    "The number of training batches",  # a small data set has few batches
    "Found .* in eval mode at the start of training",  # network.frozen_statistics=true
)

_FIXED = {
    *("ema", "init_from", "level", "network", "optimizer", "representation", "scheduler", "seed"),
    "task",
}
"""Groups and settings that a resumed run takes from its folder and its checkpoint."""


def train(settings: TrainSettings) -> float | None:
    """Train, then evaluate the best epoch on the test fold, if it is not empty.

    The best epoch is that with the best validation score, or the last epoch without validation.

    Returns:
        Best validation score, which sweeps compare; None without a validation split.
    """
    folder = Path(HydraConfig.get().runtime.output_dir)
    lightning.seed_everything(settings.seed, workers=True, verbose=False)
    logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)  # not devices and settings
    logging.getLogger("lightning.pytorch.profilers").setLevel(logging.INFO)
    resumed = settings.resume and settings.resume / "checkpoints" / "last.ckpt"
    file = None
    if resumed is not None:
        refuse_typed(_FIXED, "that of the run, when resuming: start a new run instead")
    if resumed is None and settings.init_from is not None:
        settings, file = with_pretrained_network(settings.init_from, settings)
    run = Run(folder, settings, *build(settings, file, settings.trust))
    if resumed is None:
        _create_folder(folder)
        load_pretrained(run, settings.init_from)
        rank_zero_only(run.write_settings)()
    checkpoints = folder / "checkpoints"
    last = LastCheckpoint(checkpoints, settings.checkpoint_every_n_steps)
    best = BestCheckpoint(checkpoints, run.task.monitor, run.task.head.mode_of(run.task.monitor))
    trainer = run.trainer([last, best])
    callbacks: list[Callback] = trainer.callbacks  # type: ignore[attr-defined]
    if settings.ema is not None:
        callbacks.append(EMAWeightAveraging(trainer.strategy.root_device, decay=settings.ema))
    # Averages first: a saved one has the last step.
    callbacks.sort(key=lambda callback: not isinstance(callback, WeightAveraging))
    _fit(run, trainer, resumed)
    if resumed is not None:  # with changes, which did not keep the run from being resumed
        rank_zero_only(run.write_settings)()
    # Written before the test, whose errors must not cost a sweep the score.
    score = _best_validation_score(trainer, best, folder)
    tested = _tested_checkpoint(trainer, best, last.path)
    if len(run.data.dataset("test")):
        weights = load_plain(tested, "a checkpoint of a run", mmap=True)
        run.task.load_state_dict(weights["state_dict"])
        run.test(trainer, tested)
    else:
        rank_zero_only(print_text)(f"No {run.data.noun} to test: no results are written.")
    return score


@rank_zero_only
def _create_folder(folder: Path) -> None:
    """Create the folder of the checkpoints, which only one run may do."""
    try:
        (folder / "checkpoints").mkdir(parents=True)
    except FileExistsError as error:
        found, remedy = f"{folder}, the folder of another run", f"To continue it: resume={folder}"
        raise SettingError(
            "hydra.run.dir", found=found, expected="a new folder", remedy=remedy
        ) from error


def _fit(run: Run, trainer: lightning.Trainer, resumed: Path | None) -> None:
    """Train; a run that SIGTERM or SIGHUP ends has saved a last checkpoint."""
    if "SUBMITIT_EXECUTOR" in os.environ:  # SLURM announces the end of a job by SIGUSR2
        signal.signal(signal.SIGUSR2, lambda *_: os.kill(os.getpid(), signal.SIGTERM))
    with warnings.catch_warnings():
        for message in _EXPECTED_WARNINGS:
            warnings.filterwarnings("ignore", message)
        try:
            trainer.fit(run.task, datamodule=run.data, ckpt_path=resumed, weights_only=True)
        except SIGTERMException as ended:
            sys.exit(128 + (ended.args or (signal.SIGTERM,))[0])


def _tested_checkpoint(trainer: lightning.Trainer, best: BestCheckpoint, last: Path) -> Path:
    """Return ``best.ckpt``; without validation, make it a copy of ``last.ckpt``."""
    tested = last.with_name("best.ckpt")
    if trainer.is_global_zero and best.best_model_score is None:
        with atomic_path(tested) as path:
            shutil.copyfile(last, path)
    trainer.strategy.barrier()
    return tested


def _best_validation_score(
    trainer: lightning.Trainer, best: BestCheckpoint, folder: Path
) -> float | None:
    """Return the best validation score and write it for sweeps; None without a score."""
    if best.best_model_score is None or not best.best_model_score.isfinite():  # NaN: no labels
        return None
    score = float(best.best_model_score)
    if trainer.is_global_zero:
        content = {"figure": best.monitor, "best": score, "mode": best.mode}
        write_text(folder / OBJECTIVE_FILE, json.dumps(content) + "\n")
    return score


if __name__ == "__main__":
    main.train()
