"""What precision and compilation bring to a training step: ``python -m benchmarks precision``.

FCN-ResNet101, 16 RGB-D images of 512², forward, backward and Adam's step, in float32 (TF32 off), in
bf16 with channels last, and compiled. Without a GPU, two small images and nothing compiled: enough
to see it run.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable

import torch
from torch.nn import functional
from torch.utils.flop_counter import FlopCounterMode

from benchmarks.measuring import Table, Way, measure
from benchmarks.report import table_text
from models import FCNResNet

__all__ = ["main"]

NUM_CLASSES = 14
PEAKS = {"H200": 989e12, "H100": 989e12, "A100": 312e12}
"""Dense bf16 operations per second of the SXM modules, from their data sheets."""


def main(arguments: list[str] | None = None) -> None:
    """Print one row per way to take the step."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks precision", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="as without a GPU")
    parser.add_argument("--rounds", type=int, default=10, help="measurements per row")
    options = parser.parse_args(arguments)
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    quick = options.quick or device.type == "cpu"
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else "CPU"
    images, side, rounds = (2, 64, 1) if quick else (16, 512, options.rounds)
    torch.backends.cuda.matmul.allow_tf32 = False
    torch.backends.cudnn.allow_tf32 = False
    torch.backends.cudnn.benchmark = True

    def step(*, fast: bool, compiled: bool) -> Callable[[], None]:
        return make_step(device, images, side, fast=fast, compiled=compiled)

    first = step(fast=False, compiled=False)
    ways = [
        Way("float32", first),
        Way("bf16, channels last", step(fast=True, compiled=False), ours=True),
    ]
    if not quick:
        compiled = step(fast=True, compiled=True)
        ways.append(Way("bf16, channels last, compiled", compiled, ours=True))
    with FlopCounterMode(display=False) as counter:
        first()
    title = f"FCN-ResNet101, {images} RGB-D images of {side}², on {name}"
    table = Table("precision", title, measure(ways, rounds))
    peak = next((peak for chip, peak in PEAKS.items() if chip in name), None)
    if peak is not None:
        table.notes = [
            f"{row.name}: {counter.get_total_flops() / row.median / peak:.1%} of the bf16 peak"
            for row in table.rows
        ]
    print(table_text(table))


def make_step(
    device: torch.device, images: int, side: int, *, fast: bool, compiled: bool
) -> Callable[[], None]:
    """One training step, finished when it returns."""
    torch.manual_seed(0)
    layout = torch.channels_last if fast else torch.contiguous_format
    network = FCNResNet(in_channels=4, num_classes=NUM_CLASSES, depth=101).to(device)
    network.to(memory_format=layout)
    if compiled:
        network.compile()
    optimizer = torch.optim.Adam(network.parameters(), 1e-4)
    batch = torch.randn(images, 4, side, side, device=device).contiguous(memory_format=layout)
    labels = torch.randint(0, NUM_CLASSES, (images, side, side), device=device)

    def step() -> None:
        optimizer.zero_grad()
        with torch.autocast(device.type, torch.bfloat16, enabled=fast):
            scores = network(batch)
        torch.autograd.backward(functional.cross_entropy(scores.float(), labels))
        optimizer.step()
        if device.type == "cuda":
            torch.cuda.synchronize()

    return step
