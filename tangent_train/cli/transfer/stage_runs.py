"""The stages of a transfer as runs: what is in their folders, starting them and going on.

Beside what a run leaves, a stage's folder holds ``stage.yaml``, its config, and ``stage.json``:
which stage it is, with which settings, and a digest of the checkpoint it starts from.
"""

from __future__ import annotations

import hashlib
import json
import shlex
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from filelock import FileLock, Timeout
from omegaconf import OmegaConf

from tangent_train.cli.processes import command_line, run_environment, run_process
from tangent_train.errors import DataError, SettingError
from tangent_train.files import write_text
from tangent_train.json_text import parse_json
from tangent_train.setting_rules import Purpose, differing_settings

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from tangent_train.cli.transfer.stages import Stage

__all__ = ["State", "checkpoint_of", "run_stage", "said_as_a_command", "stage_state"]

State = Literal["new", "begun", "finished"]
"""What is in a stage's folder. A stage that only evaluates is either new or finished."""

_CONFIG = "stage.yaml"
_RECORD = "stage.json"
_RESULTS = "results.json"
_LAST = Path("checkpoints") / "last.ckpt"
_REMEDY = "Give another name=, or delete the folder to make it anew."
_MOST_NAMED = 6


def stage_state(stage: Stage) -> State:
    """What there is of a stage.

    Raises:
        SettingError: Its folder holds something else, or the same stage with other settings.
        DataError: A file of the stage cannot be read.
    """
    record = _read(stage.folder / _RECORD)
    if record is None:
        if stage.folder.exists() and any(p.name[0] != "." for p in stage.folder.iterdir()):
            raise SettingError(
                stage.folder,
                found="files that tangent-transfer did not write",
                expected="a new folder, or that of this stage",
                remedy=_REMEDY,
            )
        return "new"
    finished = (stage.folder / _RESULTS).is_file()
    begun = stage.command == "train" and (stage.folder / _LAST).is_file()
    if finished or begun:
        _check_settings(stage, record.get("settings"))
        _check_weights(stage, record)
        return "finished" if finished else "begun"
    return "new"


def run_stage(stage: Stage, state: State) -> int:
    """Start a stage, or go on with it, and wait for it.

    Args:
        stage: Not finished.
        state: What there is of it.

    Returns:
        The exit status, as a shell says it.

    Raises:
        DataError: The checkpoint it starts from is missing.
        SettingError: Another command is at it.
    """
    config = dict(stage.config)
    record = None
    if state == "begun":
        config["resume"] = str(stage.folder)
    else:
        weights = _checkpoint(stage)
        source = "init_from" if stage.command == "train" else "checkpoint"
        config[source] = None if weights is None else str(weights)
        record = {
            "stage": stage.name,
            "weights": weights and _digest(weights),
            "settings": _resolved(stage),
        }
    with _alone(stage):
        if record is not None:
            write_text(stage.folder / _RECORD, json.dumps(record, indent=1) + "\n")
        write_text(stage.folder / _CONFIG, OmegaConf.to_yaml(OmegaConf.create(config)))
        status, _ = run_process(_line(stage), run_environment())
    return status if status >= 0 else 128 - status


@contextmanager
def _alone(stage: Stage) -> Iterator[None]:
    """Keep other commands off a stage while this one runs it."""
    stage.folder.mkdir(parents=True, exist_ok=True)
    try:
        lock = FileLock(stage.folder / ".lock").acquire(blocking=False)
    except Timeout as error:
        raise SettingError(
            stage.folder,
            found=f"another tangent-transfer that runs stage {stage.name}",
            expected="none",
            remedy="Wait for it; other seeds and folds can run beside it.",
        ) from error
    with lock:
        yield


def said_as_a_command(stage: Stage, state: State) -> str:
    """What a user would type to run the stage alone."""
    if state == "begun":
        root = _resolved(stage)["data"]["root"]
        return f"tangent-train {shlex.join([f'resume={stage.folder}', f'data.root={root}'])}"
    _, _, _, command, *arguments = _line(stage)
    return f"tangent-{command} {shlex.join(arguments)}"


def checkpoint_of(weights: Path) -> Path | None:
    """The checkpoint: a file itself, of a run the one that it has tested; None if missing."""
    if weights.is_file():
        return weights
    folder = weights / "checkpoints"
    return next((p for p in (folder / "best.ckpt", folder / "last.ckpt") if p.is_file()), None)


def _line(stage: Stage) -> list[str]:
    config = (f"--config-dir={stage.folder}", f"--config-name={Path(_CONFIG).stem}")
    return command_line(stage.command, config, stage.folder)


def _checkpoint(stage: Stage) -> Path | None:
    if stage.weights is None:
        return None
    found = checkpoint_of(stage.weights)
    if found is None:
        raise DataError(
            stage.weights,
            found="no checkpoints/best.ckpt or last.ckpt",
            expected=f"the network that {stage.name} starts from",
            remedy="Delete the stages of this seed to run it all again.",
        )
    return found


def _check_settings(stage: Stage, before: Any) -> None:
    now = _resolved(stage)
    if not isinstance(before, dict):
        raise DataError(
            stage.folder / _RECORD, found=f"settings={before!r}", expected="those of the stage",
            remedy=_REMEDY,
        )  # fmt: skip
    purpose: Purpose = "transfer" if stage.command == "train" else "evaluation"
    differing = differing_settings(now, before, purpose)
    if not differing:
        return
    named = [f"{name}={then!r} (now {value!r})" for name, value, then in differing[:_MOST_NAMED]]
    more = len(differing) - len(named)
    raise SettingError(
        stage.folder,
        found=f"stage {stage.name} with " + ", ".join(named) + (f" and {more} more" * (more > 0)),
        expected="the settings of this command",
        remedy=_REMEDY,
    )


def _check_weights(stage: Stage, record: Mapping[str, Any]) -> None:
    """A network that was trained again is another one; one that is gone is not missed."""
    weights = None if stage.weights is None else checkpoint_of(stage.weights)
    gone = stage.weights is not None and weights is None
    if gone or record.get("weights") == (weights and _digest(weights)):
        return
    raise SettingError(
        stage.folder,
        found=f"stage {stage.name} of another network",
        expected="none before it" if weights is None else f"the one in {weights}",
        remedy=_REMEDY,
    )


def _digest(path: Path) -> str:
    status = path.stat()
    return _digest_of(path, status.st_mtime_ns, status.st_size)


@lru_cache(maxsize=64)
def _digest_of(path: Path, _changed: int, _size: int) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, lambda: hashlib.blake2b(digest_size=16)).hexdigest()


def _resolved(stage: Stage) -> dict[str, Any]:
    config: Any = OmegaConf.to_container(OmegaConf.create(stage.config), resolve=True)
    return config


def _read(path: Path) -> dict[str, Any] | None:
    """The record of a stage; None where there is none."""
    if not path.is_file():
        return None
    try:
        content = parse_json(path.read_bytes())
    except ValueError as error:
        first_line = str(error).partition("\n")[0]
        raise DataError(
            path, found=first_line, expected="as tangent-transfer wrote it", remedy=_REMEDY
        ) from error
    if not isinstance(content, dict):
        raise DataError(path, found=type(content).__name__, expected="settings", remedy=_REMEDY)
    return content
