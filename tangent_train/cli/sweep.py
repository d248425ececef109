"""Sweeps: every job is an ordinary run, in a process of its own.

Lightning starts a process per device with the command line it finds, which has to be that of one
run; but a launcher of Hydra runs jobs in its own process. So a job starts one and waits for it.
"""

from __future__ import annotations

import os
from collections.abc import Collection
from pathlib import Path

from hydra.core.hydra_config import HydraConfig
from hydra.errors import CompactHydraException
from hydra.types import RunMode
from omegaconf import DictConfig

from tangent_train.cli.processes import command_line, run_process
from tangent_train.errors import SettingError
from tangent_train.files import parse_json

OBJECTIVE_FILE = "validation.json"
"""In a run's folder: the figure of its best epoch on the validation split."""

_OF_THE_SWEEP = ("hydra.sweep", "hydra.launcher.", "hydra.mode=", "hydra.run.", "hydra/")
_GROUPS = ("launcher=", "sweep=")


def in_sweep() -> bool:
    """Return True in a job of a sweep, to be run by `run_job`."""
    return HydraConfig.get().mode == RunMode.MULTIRUN


def run_job(
    command: str, config: DictConfig, added: Collection[str], visible_gpus: str | None
) -> float | None:
    """Run one job of a sweep as a process and wait for it.

    Args:
        command: Command of the sweep.
        config: Config of the job.
        added: Overrides that were not typed.
        visible_gpus: ``CUDA_VISIBLE_DEVICES`` where the sweep was started.

    Returns:
        The run's best validation score; None without a validation split.

    Raises:
        CompactHydraException: The run failed. Hydra prints it without a traceback.
        SettingError: The sweep compares scores that its runs do not have, or looks for the worse.
    """
    hydra = HydraConfig.get()
    searches = not hydra.sweeper["_target_"].endswith("BasicSweeper")
    if searches and not config.get("data", {}).get("validation_fraction"):
        raise SettingError(
            "data.validation_fraction",
            found="no validation split, in a sweep that looks for the best validation figure",
            expected="> 0: runs are never compared on the test fold",
        )
    folder = Path(hydra.runtime.output_dir)
    (folder / OBJECTIVE_FILE).unlink(missing_ok=True)
    sources = [s.path for s in hydra.runtime.config_sources if s.provider == "command-line"]
    options = [f"--config-dir={path}" for path in sources]
    options.append(f"--config-name={hydra.job.config_name}")
    overrides = [o for o in hydra.overrides.task if o not in added and not o.startswith(_GROUPS)]
    overrides += [o for o in hydra.overrides.hydra if not o.startswith(_OF_THE_SWEEP)]
    environment = {}
    if os.environ.get("SUBMITIT_EXECUTOR") == "local":
        # submitit hides the GPUs of this machine, or shows every job the same ones.
        environment["CUDA_VISIBLE_DEVICES"] = visible_gpus
    status = run_process(command_line(command, [*options, *overrides], folder), environment)
    if status:
        raise CompactHydraException(f"job {hydra.job.num} in {folder} ended with status {status}")
    if not (folder / OBJECTIVE_FILE).is_file():
        return None
    objective = parse_json((folder / OBJECTIVE_FILE).read_bytes())
    direction = hydra.sweeper.get("direction") if searches else None
    if isinstance(direction, str) and not direction.startswith(objective["mode"]):
        raise SettingError(
            "hydra.sweeper.direction",
            found=direction,
            expected=f"{objective['mode']}imize, for {objective['figure']}",
        )
    return float(objective["best"])
