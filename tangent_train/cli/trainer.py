"""Build the Lightning trainer of a run with its loggers and callbacks."""

from __future__ import annotations

import logging
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import lightning
from lightning.pytorch.callbacks import Callback, LearningRateMonitor

from tangent_train.callbacks.checkpoints import AtomicCheckpointIO, CheckpointContents
from tangent_train.callbacks.panels import PredictionPanels
from tangent_train.callbacks.pictures import ValidationPictures
from tangent_train.callbacks.progress import ProgressBar
from tangent_train.config.build import SettingsFile, build_from_config
from tangent_train.config.setting_rules import flat_settings
from tangent_train.errors import SettingError, at_least

_SET_ELSEWHERE = {
    "callbacks": "Use the group of callbacks: '+callbacks.mine={_target_: my.Callback}'.",
    "default_root_dir": "The folder of a run is hydra.run.dir=….",
    "logger": "Use the group of loggers: logger=null, or '+logger.mine={_target_: my.Logger}'.",
    "use_distributed_sampler": "The samplers of the data count every image once on any number of "
    "processes.",
}
"""Arguments of Lightning's trainer that every run sets, and the settings to use instead."""

_EXTRAS = ("mlflow", "wandb")
"""Loggers whose packages are an extra of this package."""


def build_trainer(
    settings: Mapping[str, Any],
    folder: Path,
    task: Any,
    contents: dict[str, Any],
    callbacks: Sequence[Callback] = (),
    source: SettingsFile | None = None,
) -> lightning.Trainer:
    """Build the trainer of a run, and log its settings as hyperparameters.

    Args:
        settings: Settings of the run.
        folder: Output folder.
        task: Task to train or test.
        contents: Plain values stored in every checkpoint.
        callbacks: Callbacks of the command.
        source: File that ``settings["trainer"]`` comes from; loggers and callbacks are the user's.

    Raises:
        SettingError: A logger, a callback or the trainer cannot be built.
    """
    section = dict(settings["trainer"])
    for name, remedy in _SET_ELSEWHERE.items():
        if section.pop(name, None) is not None:
            setting = f"trainer.{name}"
            raise SettingError(setting, found="a value", expected="null", remedy=remedy)
    # Not Lightning's messages about devices and settings, but the result of a profiler.
    logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)
    logging.getLogger("lightning.pytorch.profilers").setLevel(logging.INFO)
    every, epochs = section.get("check_val_every_n_epoch"), section.get("max_epochs")
    if epochs not in (None, -1):
        at_least("trainer.max_epochs", epochs, 1)
    loggers = _build_entries(settings, "logger", {"save_dir": str(folder), **_logger_names(folder)})
    monitor = {"monitor": task.monitor, "mode": task.head.mode_of}
    plugins = section.pop("plugins", None) or []
    numbered = dict(enumerate(plugins if isinstance(plugins, list) else [plugins]))
    own_plugins = _build_entries({"trainer.plugins": numbered}, "trainer.plugins", {})
    trainer: lightning.Trainer = build_from_config(
        section,
        "trainer",
        source,
        # A shorter run is validated at its end.
        check_val_every_n_epoch=min(every, epochs) if every and (epochs or -1) > 0 else every,
        default_root_dir=str(folder),
        callbacks=[
            *callbacks,
            *_build_entries(settings, "callbacks", monitor),
            CheckpointContents(contents),
            ProgressBar(),
            PredictionPanels(folder / "panels", settings["panels"]),
            ValidationPictures(settings["validation_images"]),
            *[LearningRateMonitor()] * bool(loggers),
        ],
        logger=loggers,
        plugins=[AtomicCheckpointIO(), *own_plugins],
        use_distributed_sampler=False,
    )
    for logger in trainer.loggers:
        logger.log_hyperparams(dict(flat_settings(contents["config"])))
    return trainer


def _build_entries(settings: Mapping[str, Any], group: str, known: Mapping[str, Any]) -> list[Any]:
    """Build the entries of a section of the user's config with Hydra, except for null entries.

    Args:
        settings: Settings of the run.
        group: Name of the section.
        known: Values that replace null settings of the entries.
    """
    built = []
    for name, entry in (settings.get(group) or {}).items():
        setting = f"{group}.{name}"
        if not isinstance(entry, Mapping) or "_target_" not in entry:
            if entry is not None:
                raise SettingError(setting, found=entry, expected="a section with a _target_")
            continue
        try:
            built.append(build_from_config(_fill_null_settings(entry, known), setting))
        except SettingError as error:
            package = entry["_target_"].rpartition(".")[2].removesuffix("Logger").lower()
            is_missing = isinstance(error.__cause__, ModuleNotFoundError)
            if not is_missing or package not in _EXTRAS:
                raise
            remedy = f"Run in the checkout: pip install -e '.[{package}]'."
            expected = "an installed package"
            raise SettingError(
                setting, found=error.found, expected=expected, remedy=remedy
            ) from error
    return built


def _fill_null_settings(entry: Mapping[str, Any], known: Mapping[str, Any]) -> dict[str, Any]:
    """Replace null settings by known values; the mode is that of the monitored value."""
    if callable(mode_of := known.get("mode")):
        known = {**known, "mode": mode_of(str(entry.get("monitor") or known["monitor"]))}
    return {
        name: _fill_null_settings(value, known)
        if isinstance(value, Mapping)
        else (known.get(name) if value is None else value)
        for name, value in entry.items()
    }


def _logger_names(folder: Path) -> dict[str, str]:
    """Return the names of a run and of its group for loggers.

    The run is named after its folder below ``runs``, the group after the folder that contains it.
    """
    above, _, below = folder.absolute().as_posix().rpartition("/runs/")
    parts = below.split("/") if above else folder.absolute().parts[-2:]
    name = "/".join(parts)
    group = [part for part in parts[:-1] if not re.fullmatch(r"(fold|seed)_\d+", part)]
    return {"name": name, "run_name": name, "group": "/".join(group)}
