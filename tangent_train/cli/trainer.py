"""The Lightning trainer of a run: its loggers, its callbacks, and what every run has."""

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
from tangent_train.errors import SettingError, at_least
from tangent_train.registry import SettingsFile, build_from_config
from tangent_train.setting_rules import flat_settings

_ELSEWHERE = {
    "callbacks": "Use the group of callbacks: '+callbacks.mine={_target_: my.Callback}'.",
    "default_root_dir": "The folder of a run is hydra.run.dir=….",
    "logger": "Use the group of loggers: logger=null, or '+logger.mine={_target_: my.Logger}'.",
    "use_distributed_sampler": "The samplers of the data count every image once on any number of "
    "processes.",
}
"""Arguments of Lightning's trainer that every run sets, and where a user sets them."""

_EXTRAS = ("mlflow", "wandb")
"""Loggers with an extra of this package."""


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
        task: The task.
        contents: Plain values that every checkpoint keeps.
        callbacks: Callbacks of the command.
        source: File that ``settings["trainer"]`` comes from; loggers and callbacks never do.

    Raises:
        SettingError: A logger, a callback or the trainer cannot be built.
    """
    section = dict(settings["trainer"])
    for name, remedy in _ELSEWHERE.items():
        if section.pop(name, None) is not None:
            place = f"trainer.{name}"
            raise SettingError(place, found="a value", expected="none", remedy=remedy)
    # Lightning's logs of found devices and of settings; those of a profiler are its result.
    logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)
    logging.getLogger("lightning.pytorch.profilers").setLevel(logging.INFO)
    every, epochs = section.get("check_val_every_n_epoch"), section.get("max_epochs")
    if epochs not in (None, -1):
        at_least("trainer.max_epochs", epochs, 1)
    loggers = _build_named(settings, "logger", {"save_dir": str(folder), **_names(folder)})
    monitor = {"monitor": task.monitor, "mode": task.monitor_mode}
    place, plugins = "trainer.plugins", section.pop("plugins", None) or []
    named = dict(enumerate(plugins if isinstance(plugins, list) else [plugins]))
    trainer: lightning.Trainer = build_from_config(
        section,
        "trainer",
        source,
        # A run shorter than that is validated at its end.
        check_val_every_n_epoch=min(every, epochs) if every and (epochs or -1) > 0 else every,
        default_root_dir=str(folder),
        callbacks=[
            *callbacks,
            *_build_named(settings, "callbacks", monitor),
            CheckpointContents(contents),
            ProgressBar(),
            PredictionPanels(folder / "panels", settings["panels"]),
            ValidationPictures(settings["validation_images"]),
            *[LearningRateMonitor()] * bool(loggers),
        ],
        logger=loggers,
        plugins=[AtomicCheckpointIO(), *_build_named({place: named}, place, {})],
        use_distributed_sampler=False,
    )
    for logger in trainer.loggers:
        logger.log_hyperparams(dict(flat_settings(contents["config"])))
    return trainer


def _build_named(settings: Mapping[str, Any], group: str, known: Mapping[str, Any]) -> list[Any]:
    """Build the entries of a section of the user's config, by Hydra; null ones are left out.

    Args:
        settings: Settings of the run.
        group: Name of the section.
        known: Values for null settings of the entries.
    """
    built = []
    for name, entry in (settings.get(group) or {}).items():
        place = f"{group}.{name}"
        if not isinstance(entry, Mapping) or "_target_" not in entry:
            if entry is not None:
                raise SettingError(place, found=entry, expected="a section with a _target_")
            continue
        try:
            built.append(build_from_config(_fill(entry, known), place))
        except SettingError as error:
            package = entry["_target_"].rpartition(".")[2].removesuffix("Logger").lower()
            is_missing = isinstance(error.__cause__, ModuleNotFoundError)
            if not is_missing or package not in _EXTRAS:
                raise
            remedy = f"Run in the checkout: pip install -e '.[{package}]'."
            expected = "an installed package"
            raise SettingError(
                place, found=error.found, expected=expected, remedy=remedy
            ) from error
    return built


def _fill(entry: Mapping[str, Any], known: Mapping[str, Any]) -> dict[str, Any]:
    """Replace null settings by those that the run knows; a monitored loss is minimized."""
    if str(entry.get("monitor")).endswith("loss"):
        known = {**known, "mode": "min"}
    return {
        name: _fill(value, known)
        if isinstance(value, Mapping)
        else (known.get(name) if value is None else value)
        for name, value in entry.items()
    }


def _names(folder: Path) -> dict[str, str]:
    """Names of a run and of its group in loggers: its folder, and the one around all its runs."""
    above, _, below = folder.absolute().as_posix().rpartition("/runs/")
    *around, own = below.split("/") if above else folder.absolute().parts[-2:]
    name = "/".join([*around, own])
    group = [part for part in around if not re.fullmatch(r"(fold|seed)_\d+", part)]
    return {"name": name, "run_name": name, "group": "/".join(group)}
