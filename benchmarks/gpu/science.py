"""Tangent images, equirectangular crops and context, trained for longer and longer."""

from __future__ import annotations

import json
import os
import tempfile
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path

from benchmarks.gpu.attempts import QUICK, Attempts, part, run_command
from benchmarks.measuring import Row, Table

__all__ = ["science"]

_METHODS = {
    "tangent images": ("representation=tangent_economy_16", "network=unet_small_aux"),
    "equirectangular crops": ("representation=erp_crops", "network=unet_small_aux"),
    "tangent images with context": (
        "representation=tangent_economy_16",
        "network=unet_small_context",
    ),
}
_ORIENTATIONS = {
    "upright": (),
    "rotated": ("representation.rotation=so3", "data.test_rotation=so3"),
}
_ROUNDS = (1,) if QUICK else (15, 60, 240)
"""Epochs. A training begins if four times that of the round before fits into the time left."""


@part(360)
def science(attempts: Attempts) -> Iterator[Table]:
    """Rooms at level 8, RGB-D: every training is a ``tangent-train``, which ends with its test."""
    taken: dict[str, float] = {}
    with tempfile.TemporaryDirectory() as root:
        rooms = partial(run_command, "prepare", _rooms(Path(root)), Path(root))
        if attempts.tried("rooms", rooms) is None:
            return
        for epochs in _ROUNDS:
            for orientation, settings in list(_ORIENTATIONS.items())[-1 if QUICK else 0 :]:
                scores, seconds = [], []
                for method, chosen in _METHODS.items():
                    name = f"{method}, {orientation}"
                    run = partial(_train, Path(root), epochs, (*chosen, *settings))
                    title, most = f"{name}, {epochs} epochs", 4 * taken.get(name, 0)
                    found = attempts.tried(title, run, most)
                    if found is None:
                        continue
                    taken[name], miou = found
                    scores.append(Row(method, [100 * miou], True))
                    seconds.append(Row(method, [taken[name]], True))
                if scores:
                    after = f"science: {orientation}, {epochs} epochs"
                    yield Table(f"{after}, mIoU", scores, "%")
                    yield Table(f"{after}, training and test", seconds)


def _train(root: Path, epochs: int, settings: tuple[str, ...]) -> tuple[float, float]:
    """Seconds and mIoU of the last epoch on the test rooms."""
    folder = root / f"run {len(list(root.iterdir()))}"
    given = [*_rooms(root), f"trainer.max_epochs={epochs}", *settings]
    if not QUICK:
        workers = min(14, len(os.sched_getaffinity(0)) - 1)
        given += ["trainer.precision=bf16-mixed", f"data.num_workers={workers}"]
    start = time.perf_counter()
    run_command("train", given, folder)
    content = json.loads((folder / "results.json").read_text(encoding="utf-8"))
    return time.perf_counter() - start, max(content["miou"], 1e-6)  # no multiple of 0


def _rooms(root: Path) -> list[str]:
    level = 5 if QUICK else 8
    given = ["experiment=rooms/accuracy", f"level={level}", f"data.root={root / 'rooms'}"]
    given += [f"data.rooms.height={2 ** (level + 1)}"]
    areas = ("1", "2", "3", "4", "5a", "5b", "6") if QUICK else ()
    return given + [f"data.rooms.rooms.area_{area}={int(area in '15a')}" for area in areas]
