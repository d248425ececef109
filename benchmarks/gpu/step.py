"""Time a training step in several precisions, eager and compiled."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import torch
from torch import nn
from torch.utils.flop_counter import FlopCounterMode

from benchmarks.labels import NUM_CLASSES
from benchmarks.measuring import DEVICE, Alternative, Goal, Row, Table, attempted, measure
from models import FCNResNet, HuggingFaceNetwork, UNet
from tangent_train.rendering import TangentRepresentation
from tests.tasks.builders import segmentation_task

PEAK_FLOPS = 989e12
"""Dense bf16 operations per second of an H100 or H200 SXM (NVIDIA's data sheets)."""


_MODES: dict[str, dict[str, Any]] = {
    "float32, TF32 off": {"tf32": False},
    "float32, TF32": {},
    "bf16, channels last": {"half": True},
    "the same, compiled": {"half": True, "compiled": {}},
    "the same, CUDA graphs": {"half": True, "compiled": {"mode": "reduce-overhead"}},
}
"""Arguments of `_step`, by name of the row."""


def step(quick: bool) -> Iterator[Table]:
    """Time steps of FCN-ResNet101 (paper, level 10), SegFormer-B0, and the UNet of rooms."""
    side, count = (32, 2) if quick else (512, 16)
    widths = (4, 8, 8) if quick else (16, 32, 64, 128, 256, 256)
    fcn = FCNResNet(4, NUM_CLASSES, depth=101, frozen_statistics=True)
    segformer = HuggingFaceNetwork({"model_type": "segformer"}, NUM_CLASSES)
    cases: dict[str, tuple[nn.Module, tuple[int, ...]]] = {
        "UNet": (UNet(4, NUM_CLASSES, widths), (2, 4, 32, 32) if quick else (40, 4, 96, 96)),
        "FCN-ResNet101": (fcn, (count, 4, side, side)),
        "SegFormer-B0": (segformer, (count, 3, side, side)),
    }
    for name, (network, size) in cases.items():
        rows: list[Row] = []
        for mode, settings in _MODES.items():
            with attempted(f"{name}, {mode}"):
                alternative = Alternative(mode, _step(network, size, **settings), is_ours=True)
                rows += measure([alternative], 1 if quick else 5)
        table = Table(f"step: {name}, {size[0]} images of {size[-1]}²", rows)
        if name == "FCN-ResNet101":
            best = min(rows, key=lambda row: row.median)
            table.goals = [
                Goal("times as fast as float32", 1 / table.ratio(best.name), 4, True),
                Goal("milliseconds", 1000 * best.median, 40),
            ]
        yield table
        with FlopCounterMode(display=False) as counter:
            _step(network, size)()
        share = 100 * counter.get_total_flops() / PEAK_FLOPS
        rows = [Row(row.name, [share / s for s in row.values], True) for row in rows]
        yield Table(f"step: {name}, share of the bf16 peak of {PEAK_FLOPS:.3g}/s", rows, "%")


def _step(
    network: nn.Module,
    size: tuple[int, ...],
    *,
    tf32: bool = True,
    half: bool = False,
    compiled: dict[str, Any] | None = None,
) -> Callable[[], object]:
    """Return a training step without a loader; `compiled` are arguments of `torch.compile`."""
    torch.backends.cuda.matmul.allow_tf32 = torch.backends.cudnn.allow_tf32 = tf32
    names = ("unknown", *map(str, range(NUM_CLASSES)))
    on_gpu = DEVICE.type == "cuda"
    task = segmentation_task(
        copy.deepcopy(network),
        TangentRepresentation(base_level=0, level=4),
        names,
        partial(torch.optim.Adam, lr=1e-4),
        channels_last=half,
        compile=compiled if on_gpu or compiled is None else {"backend": "eager"},
    )
    task = task.to(DEVICE).train()
    optimizer = task.make_optimizer(task.network.parameters())
    images = torch.randn(size, device=DEVICE)
    labels = torch.randint(0, NUM_CLASSES + 1, (size[0], *size[2:]), device=DEVICE).byte()

    def take() -> None:
        optimizer.zero_grad()
        with torch.autocast(DEVICE.type, torch.bfloat16, enabled=half and on_gpu):
            loss = task.loss_sum(task(images), labels) / task.head.loss_norm(labels)
        torch.autograd.backward(loss)
        optimizer.step()

    return take
