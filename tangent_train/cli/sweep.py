"""Run every job of a sweep as an ordinary run in a separate process.

Lightning starts one process per device with the command line of its own process, which has to be
that of a single run. Hydra's launchers run jobs in their own process. So each job starts a process
and waits for it.
"""

from __future__ import annotations

import os
from collections.abc import Collection
from pathlib import Path

from hydra.core.hydra_config import HydraConfig
from hydra.errors import CompactHydraException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from tangent_train.cli.processes import command_line, run_process
from tangent_train.config.build import resolve_target
from tangent_train.errors import SettingError
from tangent_train.files import parse_json
from tangent_train.imports import elsewhere

OBJECTIVE_FILE = "validation.json"
"""File in a run's folder with the validation score of its best epoch."""

_SWEEP_OVERRIDES = ("hydra.sweep", "hydra.launcher.", "hydra.mode=", "hydra.run.", "hydra/")
_GROUPS = ("launcher=", "sweep=")


def in_sweep() -> bool:
    """Return True in a job of a sweep, which `run_job` runs."""
    return HydraConfig.get().mode == RunMode.MULTIRUN


def run_job(
    command: str, config: DictConfig, added: Collection[str], visible_gpus: str | None
) -> float | None:
    """Run one job of a sweep as a process and wait for it.

    Args:
        command: Name of the command.
        config: Composed config of the job.
        added: Overrides that the user did not type.
        visible_gpus: ``CUDA_VISIBLE_DEVICES`` of the process that started the sweep.

    Returns:
        Best validation score of the run; None without a validation split.

    Raises:
        CompactHydraException: The run failed. Hydra prints this without a traceback.
        SettingError: Runs have no validation score, or the sweep searches in the wrong direction.
    """
    hydra = HydraConfig.get()
    searches = not hydra.sweeper["_target_"].endswith("BasicSweeper")
    if searches and not config.get("data", {}).get("val_fraction"):
        raise SettingError(
            "data.val_fraction",
            found="no validation split, in a sweep that searches the best validation score",
            expected="more than 0: runs are not compared on the test fold",
        )
    if searches:
        _check_direction(config, hydra.sweeper.get("direction"))
    folder = Path(hydra.runtime.output_dir)
    (folder / OBJECTIVE_FILE).unlink(missing_ok=True)
    sources = [s.path for s in hydra.runtime.config_sources if s.provider == "command-line"]
    options = [f"--config-dir={path}" for path in sources]
    options.append(f"--config-name={hydra.job.config_name}")
    overrides = [o for o in hydra.overrides.task if o not in added and not o.startswith(_GROUPS)]
    overrides += [o for o in hydra.overrides.hydra if not o.startswith(_SWEEP_OVERRIDES)]
    environment = {}
    if os.environ.get("SUBMITIT_EXECUTOR") == "local":
        # submitit hides the GPUs of this machine, or gives every job the same ones.
        environment["CUDA_VISIBLE_DEVICES"] = visible_gpus
    status = run_process(command_line(command, [*options, *overrides], folder), environment)
    if status:
        raise CompactHydraException(f"job {hydra.job.num} in {folder} ended with status {status}")
    if not (folder / OBJECTIVE_FILE).is_file():
        return None
    return float(parse_json((folder / OBJECTIVE_FILE).read_bytes())["best"])


def _check_direction(config: DictConfig, direction: object) -> None:
    """Refuse to search for the worst score: errors are minimized."""
    with elsewhere():  # imports torch
        head = resolve_target(OmegaConf.to_container(config.task.head), "task.head")
    if isinstance(direction, str):
        is_error = head.columns[head.main_score].better == "lower"
        expected = "minimize" if is_error else "maximize"
        if direction != expected:
            raise SettingError(
                "hydra.sweeper.direction",
                found=direction,
                expected=f"{expected}, for val/{head.main_score}",
            )
