"""Loggers of a run, which is one run in each of them, also after it is resumed."""

from __future__ import annotations

import csv
import json
import re
import warnings
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from hydra.utils import get_class
from lightning.pytorch.loggers import CSVLogger, MLFlowLogger, TensorBoardLogger, WandbLogger
from lightning.pytorch.utilities import rank_zero_only

from tangent_train.config.build import build_from_config, filled
from tangent_train.console import print_text
from tangent_train.errors import SettingError, first_line
from tangent_train.files import load_plain, write_text

_IDENTITIES = {CSVLogger: "version", MLFlowLogger: "run_id", WandbLogger: "id"}
"""Arguments that continue a run; its `version` is their value."""


def start_loggers(
    sections: Mapping[str, Any] | None,
    folder: Path,
    settings: Mapping[str, Any],
    resumed: Path | None = None,
) -> list[Any]:
    """Build the loggers and log the settings once; null arguments are those of the run.

    The run is named after its folder below ``runs``, the group after the folder that contains it.
    ``loggers.json`` keeps the loggers with their identities, with which a resumed run continues in
    the same place.

    Args:
        sections: Settings of the loggers by name; None for no loggers.
        folder: Output folder of the run.
        settings: Settings of the run, as hyperparameters.
        resumed: Checkpoint from which the run is resumed; None for a new run.

    Raises:
        SettingError: A logger cannot be started, e.g. because its server does not answer.
    """
    file, loggers = folder / "loggers.json", {}
    stored = json.loads(file.read_bytes()) if resumed and file.is_file() else {}
    reached: Any = {}
    if resumed and stored:
        reached = load_plain(resumed, "a checkpoint of a run", mmap=True)
    for name, section in (sections or {}).items():
        step = reached["global_step"] if name in stored else None
        try:
            loggers[name] = _build(name, section, folder, stored.get(name, {}), step)
            if step is None:
                loggers[name].log_hyperparams(dict(settings))
            elif isinstance(loggers[name], CSVLogger):
                rank_zero_only(_continue_csv)(loggers[name], step)
            else:  # connects to a server
                getattr(loggers[name], "experiment", None)
        except SettingError:
            raise
        except Exception as error:
            place, found = f"logger.{name}", first_line(error)
            remedy = f"To log elsewhere: ~{place}"
            expected = f"that {type(error).__module__.split('.')[0]} can start it"
            raise SettingError(place, found=found, expected=expected, remedy=remedy) from error
    if loggers:
        _store(file, stored, loggers)
    for name, logger in loggers.items():
        _guard(name, logger)
    return list(loggers.values())


def _build(
    name: str, section: Any, folder: Path, identity: Mapping[str, Any], step: int | None
) -> Any:
    above, _, below = folder.absolute().as_posix().rpartition("/runs/")
    parts = below.split("/") if above else folder.absolute().parts[-2:]
    title = "/".join(parts)
    group = "/".join(part for part in parts[:-1] if not re.fullmatch(r"(fold|seed)_\d+", part))
    known = {"save_dir": str(folder), "name": title, "run_name": title, "group": group, **identity}
    if section.get("tracking_uri", "") is None:  # MLflow, without a server
        known["tracking_uri"] = f"sqlite:///{folder.absolute()}/mlflow.db"
        known["artifact_location"] = str(folder.absolute() / "mlflow_files")
        section = {"artifact_location": None, **section}
    if step is not None and issubclass(get_class(section["_target_"]), TensorBoardLogger):
        section = {"purge_step": step, **section}  # points that are logged again
    return build_from_config(filled(dict.fromkeys(identity) | section, known), f"logger.{name}")


def _continue_csv(logger: CSVLogger, step: int) -> None:
    """Keep the rows before a step in the file, which Lightning would delete."""
    file = Path(logger.log_dir, "metrics.csv")
    if not file.is_file():
        return
    with file.open(newline="") as lines:
        rows = [row for row in csv.DictReader(lines) if int(row["step"]) < step]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the deletion
        writer: Any = logger.experiment
    writer.metrics = [{name: value for name, value in row.items() if value} for row in rows]
    writer.save()


@rank_zero_only
def _store(file: Path, stored: dict[str, Any], loggers: Mapping[str, Any]) -> None:
    """Add the loggers and the identities of the run in them to a file."""
    for name, logger in loggers.items():
        arguments = [argument for kind, argument in _IDENTITIES.items() if isinstance(logger, kind)]
        stored[name] = dict.fromkeys(arguments, logger.version)
    write_text(file, json.dumps(stored) + "\n")


def _guard(name: str, logger: Any) -> None:
    """Print the first error of a logger in one line, after which it logs nothing more."""
    methods = "log_metrics", "save", "finalize"

    def call(method: Callable[..., Any], *arguments: Any, **named: Any) -> None:
        try:
            method(*arguments, **named)
        except Exception as error:
            for other in methods:
                setattr(logger, other, lambda *_, **__: None)
            print_text(f"logger.{name} logs nothing more: {first_line(error)}", error=True)

    for method in methods:
        setattr(logger, method, partial(call, getattr(logger, method)))
