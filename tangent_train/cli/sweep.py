"""Sweeps: every job is an ordinary run, in a process of its own.

Hydra's launcher runs all jobs of a sweep in one process, submitit's in a process that only submitit
can start: no place for a run (see `processes`). So a job starts one, waits for it and reads the
figure it leaves.
"""

from __future__ import annotations

import os
import signal
from pathlib import Path
from typing import TYPE_CHECKING

from hydra._internal.utils import get_args_parser
from hydra.core.hydra_config import HydraConfig
from hydra.errors import CompactHydraException
from hydra.types import RunMode

from tangent_train.cli.processes import command_line, run_environment, run_process
from tangent_train.cli.stored import stored_arguments
from tangent_train.errors import SettingError
from tangent_train.json_text import parse_json

if TYPE_CHECKING:
    from collections.abc import Sequence

    from omegaconf import DictConfig

__all__ = ["OBJECTIVE_FILE", "JobError", "in_sweep", "leave_warnings_to_the_sweep", "run_job"]

OBJECTIVE_FILE = "validation.json"
"""In a run's folder: the figure of its best epoch on the validation split."""

_GROUPS = ("launcher", "sweep")
_JOB = "TANGENT_TRAIN_SWEEP_JOB"
"""Set for jobs: an experiment may choose the sweep, and does so for its jobs as well."""

_GRID = "hydra._internal.core_plugins.basic_sweeper.BasicSweeper"


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
    line = command_line(command, _arguments(command, typed), folder)
    code, errors = run_process(line, _environment(visible_gpus))
    if code:
        job = f"job {HydraConfig.get().job.num} in {folder} ended with status {code}"
        raise JobError("\n".join([f"tangent-{command}: {job}", *errors]))
    if objective.is_file():
        return float(parse_json(objective.read_text())["best"])
    first_task = os.environ.get("SLURM_PROCID", "0") == "0"  # which writes it, perhaps later
    if needs_figure and first_task:
        raise JobError(
            f"tangent-{command}: {objective}: found no validation figure; expected one per run. "
            "Does trainer.check_val_every_n_epoch exceed trainer.max_epochs?"
        )
    return None


def _arguments(command: str, typed: Sequence[str]) -> list[str]:
    """What makes the job a single run: the options typed, the overrides of this job."""
    options = get_args_parser().parse_args(list(typed))
    named = {
        "--config-dir": options.config_dir,
        "--config-path": options.config_path,
        "--config-name": options.config_name,
    }
    arguments = [f"{name}={value}" for name, value in named.items() if value]
    # Where a stored config comes from is no setting: Hydra does not know it.
    arguments += stored_arguments(command, typed)
    hydra = HydraConfig.get().overrides
    swept = ("hydra.sweep.", "hydra.sweeper.", "hydra.launcher.", "hydra.mode=", "hydra.run.")
    groups = ("hydra/", *(f"{group}=" for group in _GROUPS), "checkpoint=", "resume=")
    arguments += [o for o in (*hydra.task, *hydra.hydra) if not o.startswith((*swept, *groups))]
    return arguments


def _environment(visible_gpus: str | None) -> dict[str, str]:
    environment = {**run_environment(), _JOB: "1"}
    if environment.get("SUBMITIT_EXECUTOR") == "local":
        # submitit hides the GPUs of this machine, or shows every job the same ones.
        environment.pop("CUDA_VISIBLE_DEVICES", None)
        if visible_gpus is not None:
            environment["CUDA_VISIBLE_DEVICES"] = visible_gpus
    return environment
