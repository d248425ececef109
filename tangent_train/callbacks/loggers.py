"""Loggers of a run, which is one run in each of them, also after it is resumed."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lightning.pytorch.loggers import MLFlowLogger, WandbLogger
from lightning.pytorch.utilities import rank_zero_only

from tangent_train.config.build import build_from_config, filled
from tangent_train.files import write_text

_IDENTITIES = {MLFlowLogger: "run_id", WandbLogger: "id"}
"""Arguments that continue a run; its `version` is their value."""


def start_loggers(
    sections: Mapping[str, Any] | None,
    folder: Path,
    settings: Mapping[str, Any],
    *,
    is_resumed: bool = False,
) -> list[Any]:
    """Build the loggers and log the settings once; null arguments are those of the run.

    The run is named after its folder below ``runs``, the group after the folder that contains it.
    ``loggers.json`` keeps the loggers with their identities, with which a resumed run continues in
    the same place; Lightning's CSV logger begins another file.

    Args:
        sections: Settings of the loggers by name; None for no loggers.
        folder: Output folder of the run.
        settings: Settings of the run, as hyperparameters.
        is_resumed: True for a resumed run.
    """
    file, loggers = folder / "loggers.json", list[Any]()
    stored = json.loads(file.read_bytes()) if is_resumed and file.is_file() else {}
    for name, section in (sections or {}).items():
        logger = _build(name, section, folder, stored.get(name, {}))
        loggers.append(logger)
        if name not in stored:
            logger.log_hyperparams(dict(settings))
        names = [argument for kind, argument in _IDENTITIES.items() if isinstance(logger, kind)]
        stored[name] = dict.fromkeys(names, logger.version)
    if loggers:
        rank_zero_only(write_text)(file, json.dumps(stored) + "\n")
    return loggers


def _build(name: str, section: Any, folder: Path, identity: Mapping[str, Any]) -> Any:
    above, _, below = folder.absolute().as_posix().rpartition("/runs/")
    parts = below.split("/") if above else folder.absolute().parts[-2:]
    title = "/".join(parts)
    group = "/".join(part for part in parts[:-1] if not re.fullmatch(r"(fold|seed)_\d+", part))
    known = {"save_dir": str(folder), "name": title, "run_name": title, "group": group, **identity}
    if section.get("tracking_uri", "") is None:  # MLflow, without a server
        known["tracking_uri"] = f"sqlite:///{folder.absolute()}/mlflow.db"
        known["artifact_location"] = str(folder.absolute() / "mlflow_files")
        section = {"artifact_location": None, **section}
    return build_from_config(filled(dict.fromkeys(identity) | section, known), f"logger.{name}")
