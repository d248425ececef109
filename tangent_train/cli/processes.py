"""Run commands as processes of their own: the jobs of a sweep, the stages of a transfer."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import sysconfig
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from hydra.experimental.callback import Callback
from hydra.types import RunMode

from tangent_train.config.settings import typed_settings
from tangent_train.console import print_text
from tangent_train.errors import DataError, SettingError
from tangent_train.files import quoted

OF_SWEEPS = ("launcher", "sweep")
"""Groups that only sweeps read."""

OBJECTIVE_FILE = "validation.json"
"""File in a run's folder with the validation score of its best epoch."""


class SweepSummary(Callback):
    """Prints the scores of the runs of a sweep when it has ended, whoever has launched them."""

    def on_multirun_end(self, config: Any, **_: Any) -> None:
        """Print a line per run."""
        folder = Path(config.hydra.sweep.dir)
        for file in sorted(folder.rglob("results.json")):
            content = json.loads(file.read_bytes())
            name, best = next(iter(content["scores"])), file.with_name(OBJECTIVE_FILE)
            scores = [f"{name} {content['scores'][name]:.4g}"]
            if best.is_file():
                validation = json.loads(best.read_bytes())
                scores.append(f"{validation['figure']} {validation['best']:.4g}")
            print_text(f"{file.parent}: {', '.join(scores)}")
        print_text(f"A table of the settings: tangent-report {folder}")


def in_sweep() -> bool:
    """Return True in a job of a sweep, which `run_job` runs."""
    return HydraConfig.get().mode == RunMode.MULTIRUN


def run_job(command: str) -> float | None:
    """Run one job of a sweep as a process, which may start one process per device.

    Args:
        command: Name of the command.

    Returns:
        Best validation score of the run, which sweepers compare; None without one.

    Raises:
        DataError: The run failed.
        SystemExit: The sweeper searches in the other direction, or a run of a search did not begin.
    """
    hydra = HydraConfig.get()
    folder = Path(hydra.runtime.output_dir)
    arguments = [text for text in typed_settings() if not text.startswith(OF_SWEEPS)]
    if (folder / "checkpoints" / "last.ckpt").exists():  # SLURM has started the job again
        arguments = [f"resume={quoted(folder)}"]
    sources = [s.path for s in hydra.runtime.config_sources if s.provider == "command-line"]
    arguments += [f"--config-dir={path}" for path in sources]
    if status := run_process(command_line(command, arguments, folder)):
        found = f"a run that ended with status {status}"
        error = DataError(folder, found=found, expected="a finished run")
        if hydra.sweeper.get("max_failure_rate") and not (folder / "checkpoints").exists():
            sys.exit(f"tangent-{command}: {error}")  # a search ends at a wrong setting
        raise error
    file = folder / OBJECTIVE_FILE
    if not file.is_file():
        return None
    content = json.loads(file.read_bytes())
    needed = f"{content['mode']}imize"
    found = hydra.sweeper.get("direction") or needed
    if found != needed:  # the sweeper would search for the worst score
        expected = f"{needed}, for {content['figure']}"
        sys.exit(
            f"tangent-{command}: "
            f"{SettingError('hydra.sweeper.direction', found=found, expected=expected)}"
        )
    return float(content["best"])


def command_line(command: str, arguments: Sequence[str], folder: Path) -> list[str]:
    """Return the command line of one run.

    Args:
        command: Name of the command, e.g. train.
        arguments: Options and overrides.
        folder: Run folder.
    """
    program = Path(sysconfig.get_path("scripts"), f"tangent-{command}")
    return [str(program), *arguments, f"hydra.run.dir={quoted(folder)}"]


def run_process(line: Sequence[str]) -> int:
    """Run a command, wait for it also after an interrupt, and return its status."""
    with subprocess.Popen(line, env=os.environ) as process:
        return process.wait()
