"""``tangent-train``: train a network, then evaluate it."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import sys
import warnings
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import lightning
from hydra.core.hydra_config import HydraConfig
from lightning.fabric.utilities.exceptions import MisconfigurationException
from lightning.pytorch.callbacks import EMAWeightAveraging
from lightning.pytorch.utilities import rank_zero_only
from lightning.pytorch.utilities.exceptions import SIGTERMException

from tangent_train.callbacks.checkpoints import BestCheckpoint, LastCheckpoint
from tangent_train.checkpoints.content import read_checkpoint
from tangent_train.cli.command_settings import TrainSettings
from tangent_train.cli.compose import quoted
from tangent_train.cli.pretrained import load_pretrained, with_pretrained_network
from tangent_train.cli.remembered import remember_settings, remembered_settings
from tangent_train.cli.run import Run, machine_faults
from tangent_train.cli.settings import names_of, parse_settings
from tangent_train.cli.stored import is_own_option
from tangent_train.cli.sweep import OBJECTIVE_FILE
from tangent_train.config.build import SettingsFile
from tangent_train.config.setting_rules import differing_settings, flat_settings, from_file
from tangent_train.console import print_text
from tangent_train.errors import DataError, SettingError
from tangent_train.files import atomic_path, write_text


def train(settings: Mapping[str, Any], source: SettingsFile | None = None) -> float | None:
    """Train, then evaluate the best epoch on the test fold, if it is not empty.

    The best epoch is that with the best validation score, or the last epoch without validation.

    Args:
        settings: Composed ``train.yaml``, or the settings of a resumed run.
        source: File that settings come from, see `build_from_config`.

    Returns:
        Best validation score, which sweeps compare; None without a validation split.
    """
    files, resumed = parse_settings(TrainSettings, settings), None
    if files.resume is not None:
        resumed = files.resume / "checkpoints" / "last.ckpt"
        _check_resumed(settings, resumed)
    elif files.init_from is not None:
        settings, source = with_pretrained_network(files.init_from, settings)
    run = Run.create(settings, source)
    if resumed is None:
        load_pretrained(files.init_from, run)
    checkpoints = run.folder / "checkpoints"
    needed = _settings_to_type_again(_remember(run))
    last = LastCheckpoint(checkpoints, settings["checkpoint_every_n_steps"], needed)
    best = BestCheckpoint(checkpoints, run.task.monitor, run.task.mode_of(run.task.monitor))
    trainer = run.trainer([last, best])
    if settings["ema"] is not None:  # the first callback: the saved average has the last step
        average = EMAWeightAveraging(trainer.strategy.root_device, decay=settings["ema"])
        trainer.callbacks.insert(0, average)  # type: ignore[attr-defined]
    with machine_faults(run.folder, run.data):
        with _training_faults(resumed, last):
            trainer.fit(run.task, datamodule=run.data, ckpt_path=resumed, weights_only=True)
        # Written before the test, whose errors must not cost a sweep the score.
        score = _best_validation_score(trainer, best, run.folder)
        tested = _tested_checkpoint(trainer, best, last.path)
        if len(run.data.dataset("test")):
            run.test(trainer, tested)
        else:
            rank_zero_only(print_text)(f"No {run.data.noun} to test: no results are written.")
    return score


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
        content = {"figure": best.monitor, "best": score}
        write_text(folder / OBJECTIVE_FILE, json.dumps(content) + "\n")
    return score


@contextmanager
def _training_faults(resumed: Path | None, last: LastCheckpoint) -> Iterator[None]:
    """Explain errors of a training, and hide warnings that do not apply to it."""
    with warnings.catch_warnings():
        # A resumed run has checkpoints.
        warnings.filterwarnings("ignore", "Checkpoint directory .* exists and is not empty")
        # The data module, not its loader, stores where to continue.
        warnings.filterwarnings("ignore", ".* your dataloader is not resumable")
        # A run may have no validation; a small data set has few batches.
        warnings.filterwarnings("ignore", "Total length of `list` across ranks is zero")
        warnings.filterwarnings("ignore", "The number of training batches")
        # This is what network.frozen_statistics=true does.
        warnings.filterwarnings("ignore", "Found .* in eval mode at the start of training")
        try:
            yield
        except SIGTERMException:
            sys.exit(128 + signal.SIGTERM)
        except (AttributeError, KeyError, RuntimeError, TypeError, ValueError) as error:
            other = isinstance(error, DataError | SettingError) or (
                isinstance(error, RuntimeError) and "state_dict" not in str(error)
            )
            if resumed is None or last.has_begun or other:
                raise
            raise DataError(
                resumed,
                found=f"a checkpoint that cannot be resumed ({type(error).__name__}: {error})",
                expected="the last checkpoint of this run",
            ) from error
        except MisconfigurationException as error:
            raise SettingError("trainer", found=error, expected="valid settings") from error


def _check_resumed(settings: Mapping[str, Any], checkpoint: Path) -> None:
    """Refuse to resume a run with other settings, or for fewer epochs than it has begun."""
    content = read_checkpoint(checkpoint, ("config", "epoch", "state_dict"))
    for name, now, then in differing_settings(settings, content["config"], "resume"):
        raise SettingError(
            name,
            found=f"{now!r} for a run that began with {then!r}",
            expected="the same value",
            remedy="Leave the setting out, or start a new run.",
        )
    begun, epochs = (content["epoch"] or 0) + 1, settings["trainer"].get("max_epochs")
    if isinstance(epochs, int) and -1 < epochs < begun:  # the trainer refuses other types
        raise SettingError(
            "trainer.max_epochs",
            found=f"{epochs} for a run that is in its epoch {begun}",
            expected=f"{begun} or more",
        )


def _remember(run: Run) -> Collection[str]:
    """Remember the user's settings for this machine; return the names of the remembered ones.

    In a resumed run, settings that were remembered before are among the overrides.
    """
    overrides = HydraConfig.get().overrides.task
    names = names_of(overrides)
    choices = HydraConfig.get().runtime.choices
    options = [(group, choices.get(group)) for group in ("data", "experiment")]
    # Paths from options of this program are composed again and need not be remembered.
    is_composed = "data" in choices and all(o is None or is_own_option(g, o) for g, o in options)
    local = {
        name: quoted(os.path.abspath(value))  # noqa: PTH100 - resolves no links
        for name, value in flat_settings({"data": run.settings["data"]})
        if isinstance(value, str) and not from_file(name, value)
        if name in names or not is_composed
    }
    typed = (text.lstrip("+").partition("=") for text in overrides)
    local |= {n: v for n, _, v in typed if re.match(r"logger$|(logger|callbacks)\.", n)}
    rank_zero_only(remember_settings)(run.folder, local)
    return remembered_settings(run.folder, ("data", "logger", "callbacks"))


def _settings_to_type_again(remembered: Collection[str]) -> list[str]:
    """Return typed machine-specific settings that no file stores: resuming needs them again."""
    # A setting that was added with + may be in the config of a resumed run: ++ covers both cases.
    overrides = [re.sub(r"^\++", "++", text) for text in HydraConfig.get().overrides.task]
    named = [(text, *text.lstrip("+").partition("=")[::2]) for text in overrides]
    return [
        text
        for text, name, value in named
        if name == "trust" or not (name in remembered or from_file(name, value))
        if not is_own_option(name, value)  # stored among the run's choices
    ]
