"""Time a training step and an evaluation of each method of docs/results/prior_methods.md, by level.

A step trains on one panorama (on four crops of 90°), an evaluation labels one. Both include
rendering. Seconds are CPU time of one thread, so that other programs on the machine matter less.
"""

from __future__ import annotations

import ctypes
import tempfile
import time
from collections.abc import Callable, Iterator
from functools import partial

import torch

from benchmarks.measuring import Row, Table, attempted, peak_mib
from benchmarks.training import built, quiet

_UNET = "network=unet_small task.channels_last=true"
_WIDTHS = "network.widths=[16,32,64,128,256,256]"  # as many parameters as the UNet, or fewer
METHODS = {
    "tangent images, b = 0": f"{_UNET} representation=tangent",
    "tangent images, b = 1": f"{_UNET} representation.base_level=1",
    "horizontal views": f"{_UNET} representation=horizontal",
    "ERP, whole": f"{_UNET} representation=erp",
    "ERP, 90° crops": f"{_UNET} representation=erp_crops data.batch_size=4",
    "ugscnn": f"network=ugscnn {_WIDTHS}",
    "hexrunet": f"network=hexrunet {_WIDTHS}",
    "spherephd": f"network=spherephd {_WIDTHS}",
    "spherenet_icosphere": f"network=spherenet_icosphere {_WIDTHS}",
    "icocnn": "network=icocnn network.widths=[4,8,16,32,32]",
    "spherenet_unet": "network=spherenet_unet",
    "spherical_unet": "network=spherical_unet",
    "spherical_segformer": "network=spherical_segformer",
    "sfno": "network=sfno",
}
"""Settings besides ``experiment=rooms/methods``, by name of the method."""

_ROUNDS = {5: 5, 6: 3}
"""Calls by level; at higher levels, one call without a warm-up."""


def methods(quick: bool) -> Iterator[Table]:
    """Measure all methods at levels 5 to 8: seconds of steps and evaluations, and peak memory."""
    for level in (5,) if quick else (5, 6, 7, 8):
        rounds = 1 if quick else _ROUNDS.get(level, 1)
        tables = {
            name: Table(f"methods: {name}, level {level}", [], unit)
            for name, unit in (("step", "s"), ("evaluation", "s"), ("memory of a step", "MiB"))
        }
        with tempfile.TemporaryDirectory() as root, quiet():
            for name, text in METHODS.items():
                with attempted(f"{name}, level {level}"):
                    step, evaluate = _calls(
                        [f"level={level}", *text.split()], root, 2 ** (level + 1)
                    )
                    if rounds > 1:
                        step(), evaluate()
                    ctypes.CDLL(None).malloc_trim(0)  # or the step reuses memory that is free
                    times: tuple[list[float], ...] = [], []
                    mib = peak_mib(partial(_time, step, times[0]))
                    for _ in range(rounds - 1):
                        _time(step, times[0])
                    for _ in range(rounds):
                        _time(evaluate, times[1])
                    for table, values in zip(tables.values(), (*times, [mib]), strict=True):
                        table.rows.append(Row(name, values, is_ours=True))
        yield from tables.values()


def _time(call: Callable[[], object], times: list[float]) -> None:
    """Append the CPU seconds of a call."""
    start = time.process_time()
    call()
    times.append(time.process_time() - start)


def _calls(settings: list[str], root: str, rows: int) -> tuple[Callable[[], object], ...]:
    """Return a training step on one panorama and the evaluation of one, rendering included."""
    settings = ["experiment=rooms/methods", "data.batch_size=1", *settings]
    data, task = built(settings, f"{root}/rooms", rows)
    data.setup("test")
    optimizer = torch.optim.AdamW(task.parameters())

    def step() -> None:
        task.train()
        batch = next(iter(data.train_dataloader()))
        images, labels = task.training_pairs(batch._replace(images=data.normalized(batch)))
        optimizer.zero_grad()
        loss = task.loss_sum(task(images), labels) / task.head.loss_norm(labels)
        torch.autograd.backward(loss)
        optimizer.step()

    def evaluate() -> None:
        task.eval()
        batch = next(iter(data.test_dataloader()))
        task.evaluate(batch._replace(images=data.normalized(batch)))

    return step, evaluate
