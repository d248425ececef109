"""CPU time of short commands, compared with importing the libraries that they need."""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from benchmarks.measuring import Goal, Row, Table, tangent_network
from tangent_train.geometry import equirect_shape
from tangent_train.inference.export import export_network

IMAGES, TORCH = "import cv2, numba", "import torch, numba"
HELP = "tangent-train --help"
REFUSED = "tangent-render, missing input"
RENDER = "tangent-render, one panorama"
PREDICT = "tangent-predict, one panorama"


def start(quick: bool) -> Iterator[Table]:
    """Yield a table of CPU seconds, of user and system, of whole processes."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        level = 4 if quick else 8
        cv2.imwrite(str(folder / "pano.png"), np.zeros((*equirect_shape(level), 3), np.uint8))
        export_network(tangent_network(level, (8, 16)), folder / "net.safetensors")
        lines = {
            IMAGES: IMAGES,
            TORCH: TORCH,
            HELP: _command("train", "--help"),
            REFUSED: _command("render", "input=missing.png", "output=none"),
            RENDER: _command("render", "input=pano.png", "output=views"),
            PREDICT: _command(
                "predict", "checkpoint=net.safetensors", "input=pano.png", "output=labels"
            ),
        }
        rows = {line: Row(line, [], is_ours=line not in (IMAGES, TORCH)) for line in lines}
        for number in range(1 if quick else 4):
            for line, code in lines.items():
                seconds = _cpu_seconds(code, folder, number)
                if number or quick:  # the first round fills caches
                    rows[line].values.append(seconds)
    best = {line: min(row.values) for line, row in rows.items()}
    goals = [
        Goal(f"seconds of {HELP}", best[HELP], 1),
        Goal(f"seconds of {REFUSED}", best[REFUSED], 1),
        Goal(f"seconds of {RENDER} over {IMAGES}", best[RENDER] - best[IMAGES], 2),
        Goal(f"seconds of {PREDICT} over {TORCH}", best[PREDICT] - best[TORCH], 3),
    ]
    yield Table("start: CPU time", [*rows.values()], "s", goals)


def _command(name: str, *arguments: str) -> str:
    return (
        "import sys; from tangent_train.cli import main; "
        f"sys.argv = ['tangent-{name}', *{arguments!r}]; main.{name}()"
    )


def _cpu_seconds(code: str, folder: Path, number: int) -> float:
    """Return the user and system seconds of a process; outputs are new in each round."""
    code = code.replace("output=", f"output={number}")
    top = str(Path(__file__).parents[1])
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run(
        [sys.executable, "-c", code],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": top},
        capture_output=True,
        check=False,
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
