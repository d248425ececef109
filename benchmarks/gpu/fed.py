"""Whether the loader keeps the GPU busy: a training from the prepared store, by workers."""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import lightning
import torch
from lightning.pytorch.callbacks import Callback
from torch import Tensor
from torch.profiler import ProfilerActivity, profile

from benchmarks.gpu.device import DEVICE, QUICK, tried
from benchmarks.measuring import Goal, Row, Table
from benchmarks.training import built, quiet
from datamodules.core.inputs import normalize
from datamodules.core.samples import TrainingSample
from tangent_train.callbacks.progress import ProgressBar
from tangent_train.rendering import equirect_to_tangent

__all__ = ["fed"]

_WARM, _TIMED, _PROFILED = (1, 2, 1) if QUICK else (8, 30, 10)

_Figures = tuple[float, float]
"""Seconds of a step, and the percentage of the time in which the device worked."""


def fed(_quick: bool) -> Iterator[Table]:
    """The paper's best row at level 10, in bf16: FCN-ResNet101 on 16 RGB-D images a step."""
    settings = ["experiment=paper/semseg_s10_b1_rgbd", "network.weights=null"]
    settings += ["task.images_per_chunk=null", "task.channels_last=true", "data.in_memory=false"]
    settings += [f"task.class_weights={[1] * 13}"]
    level, rooms = (5, 4) if QUICK else (10, 32)
    settings += [f"level={level}", *(["network.depth=50"] if QUICK else [])]
    with tempfile.TemporaryDirectory() as root:
        store = f"data.store={root}/store"
        made = partial(built, [*settings, store], f"{root}/rooms", 2 ** (level + 1), rooms)
        both = tried("rooms and store", made)
        if both is None:
            return
        data, task = both
        source = data.source("train")
        source.items = [*source.items] * 64  # one long epoch
        figures: dict[str, _Figures | None] = {}
        batch = next(iter(data.train_dataloader()))
        batch = batch._replace(images=data.samples.normalized(batch))
        steps = _WARM + _TIMED + _PROFILED
        batch = _on_device(batch)
        alone = partial(_fit, task, train_dataloaders=_Batches(lambda _: batch, steps))
        figures["the step alone"] = tried("the step alone", alone)
        cores = len(os.sched_getaffinity(0))
        for workers in (0,) if QUICK else [n for n in (2, 4, 8, 12, 15) if n < cores]:
            data.num_workers = workers
            name = f"{workers} workers"
            figures[name] = tried(name, partial(_fit, task, datamodule=data))
        name = "rendered on the GPU, whole panoramas in pinned memory"
        figures[name] = tried(
            name, lambda: _fit(task, train_dataloaders=_Batches(_Rendered(data), steps))
        )
    found = {name: each for name, each in figures.items() if each is not None}
    yield Table("fed: a training step", [Row(n, [s], True) for n, (s, _) in found.items()])
    rows = [Row(name, [busy], True) for name, (_, busy) in found.items()]
    best = max(busy for name, (_, busy) in found.items() if "workers" in name)
    goal = Goal("busy with the best number of workers, percent", best, 95, True)
    yield Table("fed: share of the time in which the device works", rows, "%", [goal])


def _fit(task: Any, **given: Any) -> _Figures:
    """Train for some steps as `tangent-train` does."""
    clock = _Clock()
    with quiet():
        trainer = lightning.Trainer(
            accelerator="auto",
            devices=1,
            precision="32-true" if QUICK else "bf16-mixed",
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
    """Times some steps after the first ones, then profiles some."""

    def __init__(self) -> None:
        kind = ProfilerActivity.CPU if QUICK else ProfilerActivity.CUDA
        self._profiler = profile(activities=[kind])
        self._start = self.step_s = self.busy = 0.0

    def on_train_batch_end(self, trainer: lightning.Trainer, *_: Any) -> None:
        """Begin or end at a step."""
        step = trainer.global_step
        if step not in (_WARM, _WARM + _TIMED, _WARM + _TIMED + _PROFILED):
            return
        if not QUICK:
            torch.cuda.synchronize()
        now = time.perf_counter()
        if step == _WARM + _TIMED:
            self.step_s = (now - self._start) / _TIMED
            self._profiler.start()
        elif step > _WARM:
            self._profiler.stop()
            self.busy = 100 * _union_s(self._profiler) / (now - self._start)
        self._start = time.perf_counter()


def _union_s(profiler: Any) -> float:
    """Seconds in which at least one kernel or copy ran."""
    kind = "CPU" if QUICK else "CUDA"
    events = [event for event in profiler.events() if event.device_type.name == kind]
    events = [event for event in events if not getattr(event, "is_user_annotation", False)]
    spans = [(event.time_range.start, event.time_range.end) for event in events]
    total, until = 0.0, 0.0
    for start, end in sorted(spans):
        total += max(0.0, end - max(start, until))
        until = max(until, end)
    return total / 1e6


def _on_device(batch: Any) -> Any:
    return batch._replace(
        **{
            name: value.to(DEVICE)
            for name, value in batch._asdict().items()
            if isinstance(value, Tensor)
        }
    )


class _Batches:
    """A loader of batches that are made in this process."""

    def __init__(self, make: Callable[[int], Any], steps: int) -> None:
        self._make, self._steps = make, steps

    def __len__(self) -> int:
        return self._steps

    def __iter__(self) -> Iterator[Any]:
        return map(self._make, range(self._steps))


class _Rendered:
    """Batches that are rendered on the device from panoramas in pinned memory."""

    def __init__(self, data: Any) -> None:
        self._data = data
        self._panoramas = [self._pinned(k) for k in range(4 if QUICK else 16)]

    def _pinned(self, index: int) -> list[Tensor]:
        image = self._data.source("train").read(index)
        parts = (
            torch.tensor(image.rgb),
            torch.tensor(image.depth.clip(max=2048)),
            torch.tensor(image.labels),
        )
        return [part if QUICK else part.pin_memory() for part in parts]

    def __call__(self, step: int) -> Any:
        grid, sets = self._data.representation.grid, []
        for k in range(4):
            chosen = self._panoramas[(4 * step + k) % len(self._panoramas)]
            rgb, depth, labels = (part.to(DEVICE, non_blocking=True) for part in chosen)
            faces = torch.randperm(grid.num_images)[:4].numpy()
            images = equirect_to_tangent(rgb.movedim(-1, 0).float(), grid, faces)
            exact = torch.stack([depth.to(torch.int16), labels.to(torch.int16)])
            steps, truth = equirect_to_tangent(exact, grid, faces, "nearest").unbind(1)
            sets.append((images.movedim(1, -1), steps, truth.byte()))
        rgb, depth, labels = (torch.stack(part) for part in zip(*sets, strict=True))
        inputs = normalize((rgb, depth), self._data.normalization, ("rgb", "depth"))
        rays = torch.empty(4, 0, 3, 3, device=DEVICE)
        return TrainingSample(inputs, labels, rays, torch.arange(4))  # type: ignore[arg-type]
