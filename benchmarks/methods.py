"""Time a training step and an evaluation of each method of docs/results/prior_methods.md, by level.

A step trains on one panorama, an evaluation labels one; both include rendering. Seconds are CPU
time of one thread, so that other programs on the machine matter less.
"""

from __future__ import annotations

import ctypes
import tempfile
import time
from collections.abc import Callable, Iterator

import torch

from benchmarks.measuring import Alternative, Row, Table, attempted, measure, peak_mib
from benchmarks.training import built, quiet

METHODS = {
    "tangent images, b = 0": "network=unet_small",
    "tangent images, b = 1": "network=unet_small representation.base_level=1",
    "level views": "network=unet_small representation=ring",
    "ERP, whole": "network=unet_small representation=erp",
    "ERP, 90° crops": "network=unet_small representation=erp_crops",
}
"""Settings besides ``experiment=rooms/methods``, by name of the method."""


def methods(quick: bool) -> Iterator[Table]:
    """Measure all methods at levels 5 to 8: seconds of steps and evaluations, and peak memory."""
    for level in (5,) if quick else (5, 6, 7, 8):
        steps, evaluations, memory = [], [], []
        with tempfile.TemporaryDirectory() as root, quiet():
            for name, text in METHODS.items():
                with attempted(f"{name}, level {level}"):
                    step, evaluate = _calls(f"level={level} {text}".split(), root, 2 ** (level + 1))
                    step(), evaluate()
                    ctypes.CDLL(None).malloc_trim(0)  # or the step reuses memory that is free
                    mib = peak_mib(step)
                    memory.append(Row(name, [mib], is_ours=True))
                    steps.append(Alternative(name, step, is_ours=True))
                    evaluations.append(Alternative(name, evaluate, is_ours=True))
            rounds = 1 if quick else 3
            rows = [measure(calls, rounds, time.process_time) for calls in (steps, evaluations)]
        yield Table(f"methods: step, level {level}", rows[0])
        yield Table(f"methods: evaluation, level {level}", rows[1])
        yield Table(f"methods: memory of a step, level {level}", memory, "MiB")


def _calls(settings: list[str], root: str, rows: int) -> tuple[Callable[[], object], ...]:
    """Return a training step on one panorama and the evaluation of one, rendering included."""
    settings = ["experiment=rooms/methods", "data.panoramas_per_step=1", *settings]
    data, task = built(settings, f"{root}/rooms", rows)
    data.setup("test")
    optimizer = torch.optim.AdamW(task.parameters())

    def step() -> None:
        task.train()
        batch = next(iter(data.train_dataloader()))
        images, labels = task.training_pairs(batch._replace(images=data.normalized(batch)))
        optimizer.zero_grad()
        torch.autograd.backward(task.loss_sum((images,), labels) / task.loss_norm(labels))
        optimizer.step()

    def evaluate() -> None:
        task.eval()
        batch = next(iter(data.test_dataloader()))
        task.evaluate(batch._replace(images=data.normalized(batch)))

    return step, evaluate
