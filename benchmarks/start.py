"""Start-up time of commands, compared with the imports they cannot do without.

Every measurement is a new interpreter, everything in the page cache.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

from benchmarks.measuring import Goal, Table, Way, measure

__all__ = ["start"]

_COMMAND = "import sys; from tangent_train.cli.main import train; sys.argv = {!r}; train()"
_FIRST_STEP = """
import os, tangent_train.tasks.base as base
base.Task.on_train_batch_end = lambda *_: os._exit(0)
"""
_SETTINGS = (
    "experiment=rooms/demo",
    "level=5",
    "data.rooms.height=64",
    "data.validation_fraction=0",
    "trainer.accelerator=cpu",
)


def start(quick: bool) -> Iterator[Table]:
    """Until a command answers, and until its first step is done."""
    with tempfile.TemporaryDirectory() as folder:
        name = "tangent-train --help"
        ways = [
            _way("import hydra", "import hydra", folder),
            _way(name, _command("--help"), folder, ours=True),
            _way("tangent-train, a setting misspelt", _command("levle=5"), folder, ours=True),
        ]
        table = Table("start: answers", measure(ways, 2 if quick else 7))
        table.goals = [Goal(f"{name}, seconds", table.rows[1].median, 1.5)]
        yield table
        step = _FIRST_STEP + _command(*_SETTINGS, f"data.root={folder}/rooms")
        imports = "import lightning, torchvision, cv2, numba"
        ways = [
            _way(imports, imports, folder),
            _way("tangent-train, until its first step is done", step, folder, ours=True),
        ]
        yield Table("start: first step", measure(ways, 1 if quick else 3))


def _command(*arguments: str) -> str:
    return _COMMAND.format(["tangent-train", *arguments])


def _way(name: str, code: str, folder: str, *, ours: bool = False) -> Way:
    root = str(Path(__file__).resolve().parents[1])
    environment = os.environ | {"PYTHONPATH": root}

    def run() -> None:
        subprocess.run(
            [sys.executable, "-c", code],
            check="misspelt" not in name,
            capture_output=True,
            cwd=folder,
            env=environment,
        )

    return Way(name, run, ours)
