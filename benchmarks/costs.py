"""What every addition to the plain network costs: ``python -m benchmarks costs``.

One training step of the experiment of ``python -m benchmarks accuracy``, of made-up images: its
time beside the plain network's (all are run in turn, round after round, medians are compared), the
parameters, and what steps add to the peak memory of a process of its own. Without a GPU it is one
thread, and the time that the process computes; on one bf16, and the peak of what torch holds there.
"""

from __future__ import annotations

import argparse
import time
import warnings
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from benchmarks.accuracy_rows import EXPERIMENT
from benchmarks.accuracy_run import composed
from benchmarks.measuring import Way, in_process, measure, peak_kib
from tangent_train.cli.build import build

if TYPE_CHECKING:
    from collections.abc import Iterator

__all__ = ["main"]

_AUX = "network=unet_small_aux"
_CONTEXT = "network=unet_small_context"
_CHUNKS = "task.images_per_chunk=10"

ADDITIONS: dict[str, tuple[str, ...]] = {
    "plain": (),
    "auxiliary head": (_AUX,),
    "auxiliary head, attention": (_CONTEXT,),
    "auxiliary head, sphere rendering": ("network=unet_small_sphere_rendering",),
    "elevation": ("data.inputs=[rgb,depth,elevation]",),
    "validity": ("data.inputs=[rgb,depth,validity]",),
    "average of the weights": ("ema=0.999",),
    "Lovász": ("task.region_loss=lovasz",),
    "Dice": ("task.region_loss=dice",),
    "10 images at once": (_CHUNKS,),
    "10 at once, auxiliary head": (_AUX, _CHUNKS),
    "10 at once, auxiliary head, attention": (_CONTEXT, _CHUNKS),
}
"""Overrides of the experiment, by what they add."""

STEPS = 3
"""That are taken to see the memory."""


class Setting(NamedTuple):
    """Where and how large.

    Attributes:
        level: Level s.
        panoramas: Of a step.
        device: ``cpu`` or ``cuda``.
        more: Further overrides.
    """

    level: int
    panoramas: int
    device: str
    more: tuple[str, ...] = ()


def main(arguments: list[str] | None = None) -> None:
    """Print one line per addition."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks costs", description=__doc__)
    add = parser.add_argument
    add("--quick", action="store_true", help="a low level and few rounds")
    add("--rounds", type=int, default=15, help="measurements per line")
    add("--level", type=int, default=6, help="level s")
    add("--panoramas", type=int, default=8, help="panoramas of a step")
    add("--device", choices=("cpu", "cuda"), default="cpu")
    add("settings", nargs="*", help="more settings of tangent-train for all lines")
    options = parser.parse_args(arguments)
    rounds = 2 if options.quick else options.rounds
    level, panoramas = (5, 4) if options.quick else (options.level, options.panoramas)
    setting = Setting(level, panoramas, options.device, tuple(options.settings))
    with one_thread(setting):
        steps = {name: TrainingStep(added, setting) for name, added in ADDITIONS.items()}
        clock = time.process_time if setting.device == "cpu" else time.perf_counter
        rows = measure([Way(name, step.run) for name, step in steps.items()], rounds, clock)
    first = steps["plain"]
    images = f"{first.image_count} images of {first.side}²"
    print(f"\none step: {images}, level {level}, {setting.device}")
    for row, (name, step) in zip(rows, steps.items(), strict=True):
        median, ratio = row.median, row.median / rows[0].median
        mebibytes = memory_of(ADDITIONS[name], setting)
        print(
            f"  {name:<40}{step.parameters:>12,} parameters{median * 1e3:>9.1f} ms{ratio:>7.2f}×"
            f"{mebibytes:>8.0f} MiB"
        )


@contextmanager
def one_thread(setting: Setting) -> Iterator[None]:
    """Without a GPU, compute in one thread."""
    before = torch.get_num_threads()
    if setting.device == "cpu":
        torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


class TrainingStep:
    """A step of a row, forward, backward and the optimizer's, on one made-up batch.

    Args:
        overrides: Of the experiment.
        setting: Where and how large.

    Attributes:
        parameters: Of the network.
        image_count: Of a step.
        side: Of the images, in pixels.
    """

    def __init__(self, overrides: tuple[str, ...], setting: Setting) -> None:
        torch.manual_seed(0)
        self._device = torch.device(setting.device)
        common = (EXPERIMENT, f"level={setting.level}", *setting.more)
        config = composed((*common, *overrides))
        data, self._task = build(config)
        self._task.to(self._device).train()
        self._task.class_weights[1:] = 1
        self._task.class_weights[0] = 0
        self._batch = _made_up(data, setting, len(self._task.class_names))
        self._optimizer = self._task.make_optimizer(self._task.parameters())
        self._average = None
        if config.ema is not None:
            averaging: Any = get_ema_multi_avg_fn(config.ema)  # type: ignore[no-untyped-call]
            self._average = AveragedModel(self._task, multi_avg_fn=averaging, use_buffers=True)
        self.parameters = sum(p.numel() for p in self._task.network.parameters())
        self.image_count = self._batch.images.shape[:2].numel()
        self.side = self._batch.images.shape[-1]

    def run(self) -> None:
        """Take it; finished when this returns."""
        task, cuda = self._task, self._device.type == "cuda"
        self._optimizer.zero_grad()
        norms = task.loss_norms(task.training_labels(self._batch))
        for part in task.training_parts(self._batch):
            with torch.autocast(self._device.type, torch.bfloat16, enabled=cuda):
                loss = (task.loss_sums(*part) / norms).sum()
            torch.autograd.backward(loss)
        self._optimizer.step()
        if self._average is not None:
            self._average.update_parameters(task)
        if cuda:
            torch.cuda.synchronize()


class _Batch(NamedTuple):
    """As of the loader, see `datamodules.samples.TrainingSample`."""

    images: torch.Tensor
    labels: torch.Tensor
    rays: torch.Tensor


def _made_up(data: Any, setting: Setting, classes: int) -> _Batch:
    """Random images and labels of views that the experiment draws."""
    rng = np.random.default_rng(0)
    views = [data.representation.sample(rng).rays() for _ in range(setting.panoramas)]
    rays = torch.from_numpy(np.stack(views))
    shape = (*rays.shape[:2], *data.representation.image_size)
    generator = torch.Generator().manual_seed(0)
    images = torch.randn((*shape[:2], data.in_channels, *shape[2:]), generator=generator)
    labels = torch.randint(0, classes, shape, generator=generator, dtype=torch.uint8)
    return _Batch(*(tensor.to(setting.device) for tensor in (images, labels, rays)))


def memory_of(overrides: tuple[str, ...], setting: Setting) -> float:
    """Mebibytes that steps add to the peak of a process of its own."""
    mebibytes: float = in_process(_added_memory, overrides, setting)
    return mebibytes


def _added_memory(overrides: tuple[str, ...], setting: Setting) -> float:
    warnings.simplefilter("ignore")
    with one_thread(setting):
        step = TrainingStep(overrides, setting)
        before = peak_kib()
        for _ in range(STEPS):
            step.run()
    if setting.device == "cuda":
        return torch.cuda.max_memory_allocated() / 2**20
    return (peak_kib() - before) / 2**10


if __name__ == "__main__":
    main()
