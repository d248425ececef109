"""Sweeps: every job is an ordinary run, in a process of its own.

Hydra's launcher runs all jobs of a sweep in one process, submitit's in a process that only submitit
can start. Lightning starts a process per device with the command line it finds: that has to be the
command line of one run. So a job starts one, waits for it and reads the figure it leaves.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections import deque
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

from hydra._internal.utils import get_args_parser
from hydra.core.hydra_config import HydraConfig
from hydra.errors import CompactHydraException
from hydra.types import RunMode

from tangent_train.errors import SettingError

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from omegaconf import DictConfig

__all__ = ["OBJECTIVE_FILE", "JobError", "in_sweep", "leave_warnings_to_the_sweep", "run_job"]

OBJECTIVE_FILE = "validation.json"
"""In a run's folder: the figure of its best epoch on the validation split."""

_GROUPS = ("launcher", "sweep")
_JOB = "TANGENT_TRAIN_SWEEP_JOB"
"""Set for jobs: an experiment may choose the sweep, and does so for its jobs as well."""

_GRID = "hydra._internal.core_plugins.basic_sweeper.BasicSweeper"
_PATIENCE_S = 30.0  # for a last checkpoint
_LINES_OF_AN_ERROR = 12


class JobError(CompactHydraException):
    """A job that failed. Hydra prints its message without a traceback."""


def in_sweep() -> bool:
    """Whether this is a job of a sweep, to be run by `run_job`.

    Raises:
        SettingError: A launcher or a sweep is chosen, but no sweep was asked for.
    """
    if HydraConfig.get().mode == RunMode.MULTIRUN:
        return True
    choices = HydraConfig.get().runtime.choices
    for group in _GROUPS:
        if choices.get(group) is not None and _JOB not in os.environ:
            raise SettingError(
                f"{group}={choices[group]}",
                found="a single run",
                expected="a sweep",
                remedy="Add -m (--multirun).",
            )
    return False


def leave_warnings_to_the_sweep() -> None:
    """In a job: do not die of the signal with which SLURM says that the time is nearly up.

    It reaches every process. submitit's ends the job, with SIGTERM, which leaves a checkpoint.
    """
    if _JOB in os.environ:
        signal.signal(signal.SIGUSR2, signal.SIG_IGN)


def run_job(
    command: str, typed: Sequence[str], visible_gpus: str | None, config: DictConfig
) -> float | None:
    """Run one job of a sweep as a process and wait for it.

    Its output is passed on. When this process is interrupted or ended, so is the job.

    Args:
        command: train, evaluate or prepare.
        typed: The command line of the sweep.
        visible_gpus: ``CUDA_VISIBLE_DEVICES`` where the sweep was started.
        config: The job's composed config.

    Returns:
        The run's best figure on its validation split; None if it has none.

    Raises:
        JobError: The run failed, or the sweep needs a figure and there is none.
    """
    needs_figure = HydraConfig.get().sweeper["_target_"] != _GRID
    if needs_figure and not config.get("data", {}).get("validation_fraction"):
        error = SettingError(
            "data.validation_fraction",
            found="no validation split, in a sweep that looks for the best validation figure",
            expected="> 0: runs are never compared on the test fold",
            remedy="For example data.validation_fraction=0.1.",
        )
        raise JobError(f"tangent-{command}: {error}")
    folder = Path(HydraConfig.get().runtime.output_dir)
    objective = folder / OBJECTIVE_FILE
    objective.unlink(missing_ok=True)
    code, errors = _run_process(_command_line(command, typed, folder), _environment(visible_gpus))
    if code:
        job = f"job {HydraConfig.get().job.num} in {folder} ended with status {code}"
        raise JobError("\n".join([f"tangent-{command}: {job}", *errors]))
    if objective.is_file():
        return float(json.loads(objective.read_text())["best"])
    first_task = os.environ.get("SLURM_PROCID", "0") == "0"  # which writes it, perhaps later
    if needs_figure and first_task:
        raise JobError(
            f"tangent-{command}: {objective}: found no validation figure; expected one per run. "
            "Does trainer.check_val_every_n_epoch exceed trainer.max_epochs?"
        )
    return None


def _command_line(command: str, typed: Sequence[str], folder: Path) -> list[str]:
    """The job as a single run in its folder."""
    options = get_args_parser().parse_args(list(typed))
    named = {
        "--config-dir": options.config_dir,
        "--config-path": options.config_path,
        "--config-name": options.config_name,
    }
    line = [sys.executable, "-m", "tangent_train.cli.main", command]
    line += [part for name, value in named.items() if value for part in (name, value)]
    # Where a stored config comes from is no setting: Hydra does not know it.
    line += [a for a in typed if a.startswith(("checkpoint=", "resume="))]
    hydra = HydraConfig.get().overrides
    swept = ("hydra.sweep.", "hydra.sweeper.", "hydra.launcher.", "hydra.mode=", "hydra.run.")
    groups = ("hydra/", *(f"{group}=" for group in _GROUPS), "checkpoint=", "resume=")
    line += [o for o in (*hydra.task, *hydra.hydra) if not o.startswith((*swept, *groups))]
    quoted = str(folder).replace("'", r"\'")
    return [*line, f"hydra.run.dir='{quoted}'"]


def _environment(visible_gpus: str | None) -> dict[str, str]:
    # Not the working folder on Python's path, as with the console scripts: a folder "models" in it
    # would be imported. A variable, because it has to reach the processes Lightning starts.
    environment = {**os.environ, "PYTHONSAFEPATH": "1", _JOB: "1"}
    if environment.get("SUBMITIT_EXECUTOR") == "local":
        # submitit hides the GPUs of this machine, or shows every job the same ones.
        environment.pop("CUDA_VISIBLE_DEVICES", None)
        if visible_gpus is not None:
            environment["CUDA_VISIBLE_DEVICES"] = visible_gpus
    return environment


def _run_process(line: Sequence[str], environment: dict[str, str]) -> tuple[int, list[str]]:
    """Run to the end; the exit status and the last lines of the standard error."""
    last: deque[str] = deque(maxlen=_LINES_OF_AN_ERROR)
    with (
        _ended_by_sigterm(),
        subprocess.Popen(
            line, env=environment, stderr=subprocess.PIPE, text=True, errors="replace"
        ) as process,
    ):
        try:
            for text in process.stderr or ():
                sys.stderr.write(text)
                sys.stderr.flush()
                last.append(text.rstrip())
            return process.wait(), list(last)
        except BaseException as error:
            _stop(process, told=isinstance(error, KeyboardInterrupt))
            raise


def _stop(process: subprocess.Popen[str], *, told: bool) -> None:
    """End the process, gently first: a terminal's Ctrl-C has already told it."""
    try:
        if not told:
            process.terminate()
        for insist in (process.terminate, process.kill):
            try:
                # Reads on, or a full pipe would keep the process from ending.
                sys.stderr.write(process.communicate(timeout=_PATIENCE_S)[1] or "")
            except subprocess.TimeoutExpired:
                insist()
            else:
                return
    except BaseException:
        process.kill()
        raise


@contextmanager
def _ended_by_sigterm() -> Iterator[None]:
    """Let SIGTERM unwind this process, so that it ends the job, rather than end it at once."""

    def leave(number: int, frame: object) -> NoReturn:
        sys.exit(128 + number)

    before = signal.signal(signal.SIGTERM, leave)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
