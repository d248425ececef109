"""CPU time and memory of ``tangent-evaluate predictions=``, compared with a bare mIoU."""

from __future__ import annotations

import json
import os
import re
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from benchmarks.measuring import Goal, Row, Table
from tangent_train.geometry import equirect_shape

NUM_CLASSES = 13
BARE = "cv2.imread of both files, np.bincount of all pixels"
OURS = "tangent-evaluate predictions=, all measures"
IMPORT = "import torch, numba"
_DISTINCT = 8
_BLOCK = 32


def scores(quick: bool) -> Iterator[Table]:
    """Yield tables of the CPU seconds of a panorama, without the start, and of peak memory."""
    few, many = (1, 2) if quick else (8, 48)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        _write_files(folder, many, equirect_shape(4 if quick else 9))
        bare, ours = Row(BARE, []), Row(OURS, [], is_ours=True)
        memory = {n: Row(f"{OURS}, {n} panoramas", [], is_ours=True) for n in (few, many)}
        libraries = Row(IMPORT, [])
        for number in range(1 if quick else 3):
            taken = {n: _run(_command(number, n), folder) for n in (few, many)}
            if number or quick:  # the first round fills caches
                bare.values.append(_bare_seconds(folder))
                seconds = (taken[many][0] - taken[few][0]) / (many - few)
                ours.values.append(max(seconds, 1e-6))
                libraries.values.append(_run(IMPORT, folder)[1])
                for n, row in memory.items():
                    row.values.append(taken[n][1])
    goals = [Goal("seconds of a panorama", ours.median, 1 / 20)]
    yield Table("scores: CPU time of a panorama", [bare, ours], "s", goals)
    goals = [Goal("MiB", memory[many].median, 500)]
    yield Table("scores: memory", [libraries, *memory.values()], "MiB", goals)


def _write_files(folder: Path, count: int, shape: tuple[int, int]) -> None:
    """Write a data set for ``data=folder`` and predictions, each of some maps repeated."""
    rng = np.random.default_rng(0)
    size, coarse = shape[::-1], [max(2, side // _BLOCK) for side in shape]
    for k in range(count):
        files = [folder / kind / f"{k}.png" for kind in ("images", "labels", "maps")]
        scores: Any = rng.normal(size=(NUM_CLASSES, *coarse)).astype(np.float32)
        for path in files:
            path.parent.mkdir(exist_ok=True)
            if k >= _DISTINCT:
                os.link(path.with_stem(str(k % _DISTINCT)), path)
                continue
            smooth = [cv2.resize(one, size, interpolation=cv2.INTER_CUBIC) for one in scores]
            cv2.imwrite(str(path), (np.argmax(smooth, axis=0) + 1).astype(np.uint8))
            scores += 0.2 * rng.normal(size=scores.shape)
    classes = {f"class {k}": k for k in range(1, NUM_CLASSES + 1)}
    (folder / "classes.json").write_text(json.dumps(classes))
    for name in ("train", "val"):
        (folder / f"{name}.txt").write_text("")


def _command(number: int, count: int) -> str:
    """Return code that scores some of the panoramas."""
    arguments = "data=folder", "data.root=.", "predictions=maps", "panels=0"
    names = "\\n".join(map(str, range(count)))
    return (
        "import sys; from pathlib import Path; from tangent_train.cli import main; "
        f"Path('test.txt').write_text('{names}'); "
        f"sys.argv = ['tangent-evaluate', *{arguments!r}, 'hydra.run.dir={number}_{count}']; "
        "main.evaluate()"
    )


def _run(code: str, folder: Path) -> tuple[float, float]:
    """Return the CPU seconds and the peak memory in MiB of a process of one thread."""
    top = str(Path(__file__).parents[1])
    env = {**os.environ, "PYTHONPATH": top, "OMP_NUM_THREADS": "1"}
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run(
        [sys.executable, "-c", f"{code}; print(open('/proc/self/status').read())"],
        cwd=folder,
        env=env,
        stdout=subprocess.PIPE,
        text=True,
        check=True,
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    seconds = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return seconds, int(re.findall(r"VmHWM:\s+(\d+) kB", done.stdout)[0]) / 2**10


def _bare_seconds(folder: Path) -> float:
    """Return the seconds of a panorama in a loop that computes mIoU only."""
    start = time.process_time()
    for k in range(2 * _DISTINCT):
        names = [str(folder / kind / f"{k % 2}.png") for kind in ("labels", "maps")]
        truth, prediction = (np.asarray(cv2.imread(n, cv2.IMREAD_UNCHANGED)) for n in names)
        pairs = truth.astype(np.int64) * (NUM_CLASSES + 1) + prediction
        np.bincount(pairs.ravel(), minlength=(NUM_CLASSES + 1) ** 2)
    return (time.process_time() - start) / (2 * _DISTINCT)
