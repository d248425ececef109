"""The folder of a run: one process has it, and nothing is left of a run that did not begin."""

from __future__ import annotations

import os
import re
import shutil
from contextlib import ExitStack, suppress
from itertools import count
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout
from hydra.experimental.callback import Callback
from omegaconf import DictConfig, OmegaConf, read_write

from tangent_train.errors import SettingError
from tangent_train.imports import elsewhere

_LOCK = ".run.lock"
_OF_SETTINGS = {_LOCK, "config.yaml", "multirun.yaml"}
"""Besides those in ``.hydra``, the files that a run writes before it begins."""

_RANKS = ("RANK", "LOCAL_RANK", "SLURM_PROCID", "JSM_NAMESPACE_RANK")
"""Where Lightning finds the number of a process of a run."""

folder_settings: list[str] = []
"""Names of folders as the config gives them, with their ``${…}``."""

folders = ExitStack()
"""The folders of this process. Closing it gives them back."""


class RunFolder(Callback):
    """Makes the folder of a run or sweep before Hydra writes to it, and locks it.

    A folder that is named after the time is always a new one. Further processes of a run are in the
    folder of the first.

    Args:
        shared: Several commands may use the folder of a run at once.
    """

    def __init__(self, *, shared: bool = False) -> None:
        self._shared = shared

    def on_run_start(self, config: DictConfig, **_: Any) -> None:
        """Take the folder of a run."""
        if int(next((os.environ[name] for name in _RANKS if name in os.environ), 0)) == 0:
            _take(config, "run", lock=not self._shared)

    def on_multirun_start(self, config: DictConfig, **_: Any) -> None:
        """Take the folder of a sweep."""
        _take(config, "sweep", lock=True)
        with elsewhere():
            import matplotlib  # noqa: F401 - Optuna imports it


def _take(config: DictConfig, section: str, *, lock: bool) -> None:
    named = OmegaConf.to_container(config.hydra[section], resolve=False)
    is_new = isinstance(named, dict) and bool(re.search(r"(?<!\\)\$\{now:", str(named["dir"])))
    folder_settings.append(str(named))
    place = Path(config.hydra[section].dir)
    if "${" in str(place.absolute()):
        raise SystemExit from SettingError(
            place.absolute(),
            found="a name with ${, which Hydra would replace",
            expected="another name for the folder of a run",
            remedy="Rename the folder, or start in another one.",
        )
    try:
        folder, made = _make(place, is_new=is_new)
        if lock:
            folders.enter_context(FileLock(folder / _LOCK, blocking=False))
    except Timeout:
        raise SystemExit from SettingError(
            folder,
            found="a run that is still running",
            expected="a finished or interrupted run, or a new folder",
            remedy="Wait for it, or give another folder.",
        )
    except OSError as error:  # Hydra would print any other exception and go on
        raise SystemExit from error
    if made:
        folders.callback(_remove_unused, *made)
    with read_write(config):
        config.hydra[section].dir = str(folder)


def _make(named: Path, *, is_new: bool) -> tuple[Path, list[Path]]:
    """Make a folder; returns it, and all that were made, the innermost last."""
    made = [path for path in reversed(named.parents) if not path.exists()]
    for path in made:
        path.mkdir(exist_ok=True)
    for number in count(1):
        folder = named if number == 1 else named.with_name(f"{named.name}_{number}")
        try:
            folder.mkdir()
        except FileExistsError:
            if not is_new:
                break
        else:
            return folder, [*made, folder]
    return folder, []


def _remove_unused(*made: Path) -> None:
    """Remove folders with nothing but settings in the innermost one, the last."""
    *parents, folder = made
    files = [path for path in folder.rglob("*") if not path.is_dir()]
    if all(path.name in _OF_SETTINGS or ".hydra" in path.parts for path in files):
        with suppress(OSError):
            shutil.rmtree(folder)
            for parent in reversed(parents):
                parent.rmdir()
