"""Measure if the loader keeps the GPU busy in a training from the cache."""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Iterator
from functools import partial
from itertools import repeat
from typing import Any

import lightning
import torch
from lightning.fabric.utilities import move_data_to_device
from lightning.pytorch.callbacks import Callback
from torch.profiler import ProfilerActivity, profile

from benchmarks.measuring import DEVICE, ON_GPU, Goal, Row, Table, attempted, busy_s
from benchmarks.training import built, quiet
from datamodules.core.dataset import Sample
from datamodules.core.inputs import normalize
from tangent_train.callbacks.progress import ProgressBar
from tangent_train.rendering import equirect_to_tangent

_WARM, _TIMED, _PROFILED = (8, 30, 10) if ON_GPU else (1, 2, 1)


def fed(quick: bool) -> Iterator[Table]:
    """Train the paper's best network at level 10, FCN-ResNet101, in bf16 on 16 images per step."""
    level, rooms = (5, 4) if quick else (10, 32)
    settings = ["experiment=paper/semseg_s10_b1_rgbd", f"level={level}", "network.weights=null"]
    settings += ["task.view_batch_size=null", "task.channels_last=true", "data.in_memory=false"]
    settings += [f"task.head.class_weights={[1] * 13}"]
    with tempfile.TemporaryDirectory() as root:
        settings.append(f"data.cache={root}/store")
        data, task = built(settings, f"{root}/rooms", 2 ** (level + 1), rooms)
        data.dataset("train").files *= 64  # one long epoch, of the list that the data module holds
        batch = next(iter(data.train_dataloader()))
        batch = move_data_to_device(batch._replace(images=data.normalized(batch)), DEVICE)
        cores = len(os.sched_getaffinity(0))
        fits = {"the step alone": partial(_fit, task, train_dataloaders=repeat(batch))}
        for workers in (0,) if quick else [n for n in (2, 4, 8, 12, 15) if n < cores]:
            fits[f"{workers} workers"] = partial(_fit, task, datamodule=data, workers=workers)
        rendered = partial(_fit, task, train_dataloaders=_rendered(data, 4 if quick else 16))
        fits["rendered on the GPU, whole panoramas in pinned memory"] = rendered
        found = {}
        for name, fit in fits.items():
            with attempted(name):
                found[name] = fit()
    yield Table("fed: a training step", [Row(n, [s], True) for n, (s, _) in found.items()])
    rows = [Row(name, [busy], True) for name, (_, busy) in found.items()]
    best = max(busy for name, (_, busy) in found.items() if "workers" in name)
    goal = Goal("busy with the best number of workers, percent", best, 95, True)
    yield Table("fed: share of the time in which the device works", rows, "%", [goal])


def _fit(task: Any, workers: int = 0, **given: Any) -> tuple[float, float]:
    """Train for some steps like `tangent-train`.

    Returns:
        Seconds per step, and the percentage of time in which the device was busy.
    """
    clock = _Clock()
    if "datamodule" in given:
        given["datamodule"].num_workers = workers
    with quiet():
        trainer = lightning.Trainer(
            accelerator="auto",
            devices=1,
            precision="bf16-mixed" if ON_GPU else "32-true",
            max_steps=_WARM + _TIMED + _PROFILED,
            max_epochs=-1,
            callbacks=[clock, ProgressBar()],
            logger=False,
            enable_checkpointing=False,
            enable_model_summary=False,
            limit_val_batches=0,
            use_distributed_sampler=False,
        )
        trainer.fit(task, **given)
    return clock.step_s, clock.busy


class _Clock(Callback):
    """Times some steps after a warm-up, then profiles some."""

    def __init__(self) -> None:
        kind = ProfilerActivity.CUDA if ON_GPU else ProfilerActivity.CPU
        self._profiler = profile(activities=[kind])
        self._start = self.step_s = self.busy = 0.0

    def on_train_batch_end(self, trainer: lightning.Trainer, *_: Any) -> None:
        """Start or stop a measurement after certain steps."""
        step = trainer.global_step
        if step not in (_WARM, _WARM + _TIMED, _WARM + _TIMED + _PROFILED):
            return
        if ON_GPU:
            torch.cuda.synchronize()
        now = time.perf_counter()
        if step == _WARM + _TIMED:
            self.step_s = (now - self._start) / _TIMED
            self._profiler.start()
        elif step > _WARM:
            self._profiler.stop()
            self.busy = 100 * busy_s(self._profiler) / (now - self._start)
        self._start = time.perf_counter()


def _rendered(data: Any, count: int) -> Iterator[Any]:
    """Yield batches rendered on the device from panoramas in pinned memory."""
    grid, panoramas = data.representation.grid, []
    for k in range(count):
        image = data.dataset("train").read(k)
        parts = map(torch.tensor, (image.rgb, image.depth.clip(max=2048), image.labels))
        panoramas.append([part.pin_memory() if ON_GPU else part for part in parts])
    while True:
        sets = []
        for k in torch.randint(count, (4,)).tolist():
            rgb, depth, labels = (part.to(DEVICE, non_blocking=True) for part in panoramas[k])
            faces = torch.randperm(grid.num_images)[:4].numpy()
            images = equirect_to_tangent(rgb.movedim(-1, 0).float(), grid, faces)
            exact = torch.stack([depth.to(torch.int16), labels.to(torch.int16)])
            steps, truth = equirect_to_tangent(exact, grid, faces, "nearest").unbind(1)
            sets.append((images.movedim(1, -1), steps, truth.byte()))
        rgb, depth, labels = (torch.stack(part) for part in zip(*sets, strict=True))
        inputs = normalize((rgb, depth), data.normalization, ("rgb", "depth"))
        lengths = torch.ones(4, 1, 1, 1)
        yield Sample(inputs, labels, lengths, torch.arange(4))  # type: ignore[arg-type]
