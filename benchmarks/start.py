"""How long commands take to start, beside what they cannot do without.

Every row is a new interpreter, everything in the page cache.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

from benchmarks.measuring import Options, Table, Way, at_most, measure
from benchmarks.rooms import few_rooms

if TYPE_CHECKING:
    from collections.abc import Iterator

__all__ = ["tables"]

HYDRA = "import hydra"
HELP = "tangent-train --help"
MISSPELT = "tangent-train, a setting misspelt"
LIBRARIES = "import lightning, torchvision, cv2, numba"
STEP = "tangent-train, until its first step is done"

_COMMAND = "import sys; from tangent_train.cli.main import train; sys.argv = {!r}; train()"
_FIRST_STEP = """
import os, sys, tangent_train.tasks.base as base
base.Task.on_train_batch_end = lambda *_: os._exit(0)
sys.argv = {!r}
from tangent_train.cli.main import train
train()
sys.exit("no step was taken")
"""
_SETTINGS = (
    "experiment=rooms/demo",
    "level=5",
    "data.validation_fraction=0",
    "data.panoramas_per_step=1",
    "trainer.accelerator=cpu",
    "trainer.devices=1",
)


def tables(options: Options) -> Iterator[Table]:
    """Before anything is computed, and until the first step."""
    with tempfile.TemporaryDirectory() as folder:
        yield _answers(Path(folder), options)
        yield _first_step(Path(folder), options)


def _way(name: str, code: str, folder: Path, *, status: int = 0, ours: bool = False) -> Way:
    """Running Python code in a process of its own."""
    source = Path(__file__).resolve().parents[1]
    path = os.pathsep.join([str(source), *filter(None, [os.environ.get("PYTHONPATH")])])

    def run() -> None:
        done = subprocess.run(
            [sys.executable, "-c", code],
            check=False,
            capture_output=True,
            text=True,
            cwd=folder,
            env=os.environ | {"PYTHONPATH": path},
        )
        if done.returncode != status:
            raise RuntimeError(f"{name} ended with {done.returncode}: {done.stderr[-2000:]}")

    return Way(name, run, ours)


def _command(*arguments: str) -> str:
    return _COMMAND.format(["tangent-train", *arguments])


def _answers(folder: Path, options: Options) -> Table:
    ways = [
        _way(HYDRA, "import hydra", folder),
        _way(HELP, _command("--help"), folder, ours=True),
        _way(MISSPELT, _command("levle=5"), folder, status=1, ours=True),
    ]
    table = Table("start: answers", "Answers at once", measure(ways, options.times(7)))
    table.goals = [at_most(HELP, table.row(HELP).median, 1.5, " s")]
    return table


def _first_step(folder: Path, options: Options) -> Table:
    command = ["tangent-train", *_SETTINGS, *few_rooms(folder / "rooms", 64)]
    ways = [
        _way(LIBRARIES, "import lightning, torchvision, cv2, numba", folder),
        _way(STEP, _FIRST_STEP.format(command), folder, ours=True),
    ]
    rows = measure(ways, options.times(3))
    return Table("start: first step", "Until the first step, rooms made before", rows)
