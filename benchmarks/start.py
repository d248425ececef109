"""Start-up time of commands, compared with the imports they cannot do without.

Every measurement is a new interpreter, everything in the page cache.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from functools import partial
from pathlib import Path

from benchmarks.measuring import Goal, Table, Way, measure

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
    name, imports = "tangent-train --help", "import lightning, torchvision, cv2, numba"
    with tempfile.TemporaryDirectory() as folder:
        run = partial(_run, folder)
        ways = [
            Way("import hydra", partial(run, "import hydra")),
            Way(name, partial(run, _command("--help")), ours=True),
            Way("tangent-train, a setting misspelt", partial(run, _command("levle=5"), 1), True),
        ]
        table = Table("start: answers", measure(ways, 2 if quick else 7))
        table.goals = [Goal(f"{name}, seconds", table.rows[1].median, 1.5)]
        yield table
        step = _FIRST_STEP + _command(*_SETTINGS, f"data.root={folder}/rooms")
        ways = [
            Way(imports, partial(run, imports)),
            Way("tangent-train, until its first step is done", partial(run, step), ours=True),
        ]
        yield Table("start: first step", measure(ways, 1 if quick else 3))


def _command(*arguments: str) -> str:
    return _COMMAND.format(["tangent-train", *arguments])


def _run(folder: str, code: str, status: int = 0) -> None:
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).resolve().parents[1])}
    line = [sys.executable, "-c", code]
    done = subprocess.run(line, check=False, capture_output=True, cwd=folder, env=environment)
    if done.returncode != status:
        raise RuntimeError(done.stderr.decode())
