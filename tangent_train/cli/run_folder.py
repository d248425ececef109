"""Folder of a run: locked by one process, and removed if the run did not begin."""

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
_SETTINGS_FILES = {_LOCK, "config.yaml", "multirun.yaml"}
"""Files that a run writes before it begins, besides those in ``.hydra``."""

_RANKS = ("RANK", "LOCAL_RANK", "SLURM_PROCID", "JSM_NAMESPACE_RANK")
"""Environment variables from which Lightning takes the rank of a process."""

folder_settings: list[str] = []
"""Names of folders as in the config, with ``${…}`` not yet replaced."""

folders = ExitStack()
"""Folders of this process. Closing it unlocks them and removes unused ones."""


class RunFolder(Callback):
    """Creates and locks the folder of a run or sweep before Hydra writes to it.

    A folder that is named after the time is always a new one. Further processes of a run use the
    folder of the first process.

    Args:
        shared: True if several commands may use the folder of a run at once.
    """

    def __init__(self, *, shared: bool = False) -> None:
        self._shared = shared

    def on_run_start(self, config: DictConfig, **_: Any) -> None:
        """Create and lock the folder of a run."""
        if int(next((os.environ[name] for name in _RANKS if name in os.environ), 0)) == 0:
            _claim_folder(config, "run", lock=not self._shared)

    def on_multirun_start(self, config: DictConfig, **_: Any) -> None:
        """Create and lock the folder of a sweep."""
        _claim_folder(config, "sweep", lock=True)
        with elsewhere():
            import matplotlib  # noqa: F401 - Optuna imports it


def _claim_folder(config: DictConfig, section: str, *, lock: bool) -> None:
    unresolved = OmegaConf.to_container(config.hydra[section], resolve=False)
    is_new = isinstance(unresolved, dict) and bool(
        re.search(r"(?<!\\)\$\{now:", str(unresolved["dir"]))
    )
    folder_settings.append(str(unresolved))
    path = Path(config.hydra[section].dir)
    if "${" in str(path.absolute()):
        raise SystemExit from SettingError(
            path.absolute(),
            found="a name with ${, which Hydra would replace",
            expected="another name for the folder of a run",
            remedy="Rename the folder, or start in another one.",
        )
    try:
        folder, created = _make_folder(path, is_new=is_new)
        if lock:
            folders.enter_context(FileLock(folder / _LOCK, blocking=False))
    except Timeout:
        raise SystemExit from SettingError(
            folder,
            found="a run that is still running",
            expected="a finished or interrupted run, or a new folder",
            remedy="Wait for it, or give another folder.",
        )
    except OSError as error:  # Hydra prints other exceptions of callbacks and continues
        raise SystemExit from error
    if created:
        folders.callback(_remove_unused, *created)
    with read_write(config):
        config.hydra[section].dir = str(folder)


def _make_folder(wanted: Path, *, is_new: bool) -> tuple[Path, list[Path]]:
    """Return a folder, and all folders that were created for it, the innermost last.

    If it has to be a new one, a number is appended to a name that exists.
    """
    created = [path for path in reversed(wanted.parents) if not path.exists()]
    for path in created:
        path.mkdir(exist_ok=True)
    for number in count(1):
        folder = wanted if number == 1 else wanted.with_name(f"{wanted.name}_{number}")
        try:
            folder.mkdir()
        except FileExistsError:
            if not is_new:
                break
        else:
            return folder, [*created, folder]
    return folder, []


def _remove_unused(*created: Path) -> None:
    """Remove folders if the last, innermost one contains only settings."""
    *parents, folder = created
    files = [path for path in folder.rglob("*") if not path.is_dir()]
    if all(path.name in _SETTINGS_FILES or ".hydra" in path.parts for path in files):
        with suppress(OSError):
            shutil.rmtree(folder)
            for parent in reversed(parents):
                parent.rmdir()
