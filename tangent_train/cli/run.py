"""What the commands do, given a composed config."""

from __future__ import annotations

import json
import signal
import sys
import warnings
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import lightning
import torch
from hydra.core.hydra_config import HydraConfig
from lightning.fabric.utilities.exceptions import MisconfigurationException
from lightning.pytorch.accelerators import CPUAccelerator
from lightning.pytorch.callbacks import LearningRateMonitor, ModelCheckpoint
from lightning.pytorch.loggers import TensorBoardLogger
from lightning.pytorch.utilities import rank_zero_only
from lightning.pytorch.utilities.exceptions import SIGTERMException
from rich.console import Console

from datamodules.core.samples import channel_names
from models import initialize
from tangent_train.callbacks.averaging import averaged_weights
from tangent_train.callbacks.checkpoints import (
    AtomicCheckpointIO,
    CheckpointContents,
    LastCheckpoint,
    best_checkpoint,
)
from tangent_train.callbacks.panels import ProgressBar
from tangent_train.callbacks.results import evaluated, pictures, write_evaluation
from tangent_train.callbacks.tensorboard import TrainingSpeed
from tangent_train.checkpoints.content import read_checkpoint, write_settings
from tangent_train.checkpoints.trained import inputs_in
from tangent_train.cli.build import Settings, build, check_numbers
from tangent_train.cli.machine import machine_faults
from tangent_train.cli.sweep import OBJECTIVE_FILE
from tangent_train.errors import DataError, SettingError
from tangent_train.files import write_text
from tangent_train.registry import make
from tangent_train.results.evaluation import headline, result_tables
from tangent_train.results.record import Record
from tangent_train.setting_rules import differing_settings, from_file

__all__ = ["best_on_validation", "build", "evaluate", "prepare", "train"]

# lightning 2.6 asks torch's tree library in a way torch ≥ 2.13 deprecates: nothing to do about it.
warnings.filterwarnings("ignore", r"`isinstance\(treespec, LeafSpec\)`", FutureWarning)


def train(settings: Settings, trust: Collection[str] | None = None) -> float | None:
    """Train, then evaluate the best epoch of the validation split (else the last) on the test fold.

    Args:
        settings: Of the run: the composed ``train.yaml``, or of a run that goes on.
        trust: Of settings that come from a file, see `registry.make`.

    Returns:
        The best figure on the validation split, what sweeps compare; None without such a split.
    """
    folder = _run_folder()
    checkpoints = folder / "checkpoints"
    check_numbers(settings)
    lightning.seed_everything(settings["seed"], workers=True, verbose=False)
    resumed = None if settings["resume"] is None else checkpoints / "last.ckpt"
    if resumed is not None:
        _check_resumed(settings, read_checkpoint(resumed, ("config",))["config"])
    data, task = build(settings, trust)
    settings = {"choices": _choices(), **settings}
    start = settings["init_from"]
    if start is not None and resumed is None:
        origins = initialize(task.network, start, _channels(Path(start), data))
        rank_zero_only(_console().print)(f"Tensors from {start}\n{origins}", markup=False)
    write_settings(folder / "config.yaml", settings)
    last = LastCheckpoint(checkpoints, settings["checkpoint_every_n_steps"], _typed_local())
    callbacks = [last, LearningRateMonitor()]
    if data.validation_fraction:
        callbacks.append(best_checkpoint(checkpoints, task.monitor))
    trainer = _trainer(settings, folder, data, task, callbacks, trust)
    if settings["ema"] is not None:  # first: the last step is in the average that is saved
        average = averaged_weights(settings["ema"], trainer.strategy.root_device)
        trainer.callbacks.insert(0, average)  # type: ignore[attr-defined]
    with warnings.catch_warnings(), machine_faults(folder, data):
        # The checkpoints of a resumed run are meant to be there.
        warnings.filterwarnings("ignore", "Checkpoint directory .* exists and is not empty")
        # Lightning looks for this in the loader; here the data module knows where to go on.
        warnings.filterwarnings("ignore", ".* your dataloader is not resumable")
        # network.frozen_statistics=true
        warnings.filterwarnings("ignore", "Found .* in eval mode at the start of training")
        try:
            trainer.fit(task, datamodule=data, ckpt_path=resumed, weights_only=True)
            # First: an error in the test must not cost a sweep its figure.
            score = best_on_validation(trainer, folder)
            best = checkpoints / "best.ckpt"
            best = best if best.exists() else checkpoints / "last.ckpt"
            _test(trainer, task, data, best, folder)
        except SIGTERMException:
            sys.exit(128 + signal.SIGTERM)
        except (AttributeError, KeyError, TypeError, ValueError) as error:
            if resumed is None or last.has_begun or isinstance(error, DataError | SettingError):
                raise
            raise DataError(
                resumed,
                found=f"what cannot be gone on with ({type(error).__name__}: {error})",
                expected="the last checkpoint of this run",
            ) from error
        except MisconfigurationException as error:  # as fewer epochs than a resumed run has done
            raise SettingError(
                "trainer", found=f"what cannot work: {error}", expected="settings that can"
            ) from error
    return score


def evaluate(settings: Settings, trust: Collection[str] | None = None) -> None:
    """Evaluate a checkpoint on the test fold of its data.

    Args:
        settings: Of the run, and ``checkpoint``.
        trust: Of settings that come from a file, see `registry.make`.

    Raises:
        SettingError: No checkpoint is given.
    """
    if settings["checkpoint"] is None:
        raise SettingError(
            "checkpoint",
            found="none",
            expected="a checkpoint written by tangent-train",
            remedy="For example: tangent-evaluate checkpoint=runs/…/checkpoints/best.ckpt",
        )
    folder = _run_folder()
    check_numbers(settings)
    lightning.seed_everything(settings["seed"], workers=True, verbose=False)
    data, task = build(settings, trust)
    settings = {"choices": _choices(), **settings}
    write_settings(folder / "config.yaml", settings)
    trainer = _trainer(settings, folder, data, task, [], trust)
    with machine_faults(folder, data):
        _test(trainer, task, data, Path(settings["checkpoint"]), folder)


def prepare(settings: Settings) -> None:
    """Make or check the data set, and its prepared store if one is set.

    Args:
        settings: The composed ``prepare.yaml``.
    """
    representation = make(settings["representation"], "representation")
    data = make(settings["data"], "data", representation=representation)
    data.prepare_data()
    data.setup()
    counts = ", ".join(f"{len(data.found().splits[s])} {s}" for s in ("train", "val", "test"))
    _console().print(f"{data.root} is ready. {data.noun.capitalize()}: {counts}.")


def _choices() -> dict[str, str]:
    """The options that the settings came from, by group."""
    chosen = HydraConfig.get().runtime.choices
    return {
        group: chosen[group] for group in ("data", "experiment", "trainer") if chosen.get(group)
    }


def _check_resumed(settings: Settings, before: Mapping[str, Any]) -> None:
    """Refuse to resume a run as another one."""
    for name, now, then in differing_settings(settings, before, "resume"):
        raise SettingError(
            name,
            found=f"{now!r} for a run that began with {then!r}",
            expected="no other than before",
            remedy="Start a new run for it.",
        )


def _typed_local() -> list[str]:
    """What was typed that no file says: a resumed run has to be told it again."""
    typed = [said.lstrip("+") for said in HydraConfig.get().overrides.task]
    names = [said.partition("=")[0] for said in typed]
    pairs = zip(names, typed, strict=True)
    return [said for name, said in pairs if name == "trust" or not from_file(name)]


def _trainer(
    settings: Settings,
    folder: Path,
    data: Any,
    task: Any,
    callbacks: list[Any],
    trust: Collection[str] | None = None,
) -> lightning.Trainer:
    contents = {
        "kind": task.kind,
        "config": settings,
        "class_names": list(data.class_names),
        **_shown(data),
    }
    common = [CheckpointContents(contents), *pictures(task.kind, folder, settings)]
    common += [TrainingSpeed(), ProgressBar()]
    section = settings["trainer"]
    every, epochs = section.get("check_val_every_n_epoch"), section.get("max_epochs")
    given = {
        # A run shorter than that is validated at its end.
        "check_val_every_n_epoch": min(every, epochs) if every and (epochs or -1) > 0 else every,
        "default_root_dir": str(folder),
        "callbacks": [*callbacks, *common],
        "logger": TensorBoardLogger(folder, name="", version="tensorboard"),
        "plugins": [AtomicCheckpointIO()],
        # The data module's samplers count every image once on any number of processes.
        "use_distributed_sampler": False,
    }
    trainer: lightning.Trainer = make(section, "trainer", trust, **given)
    if section.get("sync_batchnorm") and isinstance(trainer.accelerator, CPUAccelerator):
        raise SettingError(
            "trainer.sync_batchnorm",
            found="true, on a CPU",
            expected="false: torch has batch statistics over several processes on GPUs only",
        )
    return trainer


def _test(trainer: lightning.Trainer, task: Any, data: Any, checkpoint: Path, folder: Path) -> None:
    content = read_checkpoint(checkpoint)
    _check_fits(content, data, checkpoint)
    try:
        task.load_state_dict(content["state_dict"])
    except RuntimeError as error:
        raise SettingError(
            "network",
            found=f"other tensors than in {checkpoint} ({error})",
            expected="the network and inputs of the checkpoint",
        ) from error
    trainer.test(task, datamodule=data, verbose=False)
    record = evaluated(task, data.noun)
    total = len(data.source("test"))
    if record.images != total:
        raise RuntimeError(f"{record.images} of {total} test {data.noun} were counted")
    _report(task, record, checkpoint, folder)


def _check_fits(content: dict[str, Any], data: Any, checkpoint: Path) -> None:
    """Refuse data whose labels or inputs mean something else to the network."""
    own = {"class_names": list(data.class_names), **_shown(data)}
    for name, value in own.items():
        if content[name] != value:
            raise SettingError(
                f"data, for {checkpoint}",
                found=f"{name.replace('_', ' ')} {value}",
                expected=f"{content[name]}, which the network was trained with",
                remedy="Evaluate it on data of the same classes, with the same data.inputs and "
                "data.normalization.",
            )


def _channels(path: Path, data: Any) -> Any:
    """Names of the channels that the network of a file takes, and of those of the data."""
    before, now = inputs_in(path), getattr(data, "inputs", None)
    if before is None or now is None:
        return None
    return channel_names(before), channel_names(now)


def _shown(data: Any) -> dict[str, Any]:
    """What a network is shown of the data, as plain values."""
    mean, std = list(data.normalization.mean), list(data.normalization.std)
    inputs = {"inputs": list(data.inputs)} if hasattr(data, "inputs") else {}  # shapes have one
    return {**inputs, "normalization": {"mean": mean, "std": std}}


def best_on_validation(trainer: lightning.Trainer, folder: Path) -> float | None:
    """The best figure on the validation split, kept for sweeps; None if there is none.

    Args:
        trainer: Of the run.
        folder: Of the run.
    """
    best = next((c for c in trainer.checkpoint_callbacks if isinstance(c, ModelCheckpoint)), None)
    if best is None or best.best_model_score is None:
        return None
    if not torch.isfinite(best.best_model_score):  # no labelled pixel
        return None
    score = float(best.best_model_score)
    if trainer.is_global_zero:
        content = {"figure": best.monitor, "best": score}
        write_text(folder / OBJECTIVE_FILE, json.dumps(content) + "\n")
    return score


@rank_zero_only
def _report(task: Any, record: Record, checkpoint: Path, folder: Path) -> None:
    write_evaluation(task, record, checkpoint, folder)
    console = _console()
    console.print(headline(record), markup=False)
    console.print(result_tables(record)[0].terminal())
    console.print(
        f"Results, pictures and logs: {folder}; report.html opens in a browser.", markup=False
    )


def _run_folder() -> Path:
    return Path(HydraConfig.get().runtime.output_dir)


def _console() -> Console:
    return Console(soft_wrap=True, highlight=False)
