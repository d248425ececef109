"""Time of one training step of FCN-ResNet101: ``python -m benchmarks.training``.

16 RGB-D images of 512², forward, backward and Adam's step, in float32 (TF32 off), in bf16 with
channels last, and compiled. Rows run in turn, medians are compared. Without a GPU, two small images
and nothing compiled: enough to see it run.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable

import torch
from torch.nn import functional
from torch.utils.flop_counter import FlopCounterMode

from models import FCNResNet

NUM_CLASSES = 14
PEAKS = {"H200": 989e12, "H100": 989e12, "A100": 312e12}
"""Dense bf16 operations per second of the SXM modules, from their data sheets."""


def main(arguments: list[str] | None = None) -> None:
    """Print one row per way to take the step."""
    parser = argparse.ArgumentParser(description=__doc__)
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
    print(f"\nFCN-ResNet101, {images} RGB-D images of {side}², on {name}")
    ways = {
        "float32": make_step(device, images, side, fast=False, compiled=False),
        "bf16, channels last": make_step(device, images, side, fast=True, compiled=False),
    }
    if not quick:
        ways["bf16, channels last, compiled"] = make_step(
            device, images, side, fast=True, compiled=True
        )
    with FlopCounterMode(display=False) as counter:
        ways["float32"]()
    operations = counter.get_total_flops()
    seconds: dict[str, list[float]] = {way: [] for way in ways}
    for step in ways.values():
        for _ in range(3):  # compiles, and chooses algorithms
            step()
    for _ in range(rounds):
        for way, step in ways.items():
            start = time.perf_counter()
            step()
            seconds[way].append(time.perf_counter() - start)
    first = statistics.median(seconds["float32"])
    peak = next((peak for chip, peak in PEAKS.items() if chip in name), None)
    for way, times in seconds.items():
        median = statistics.median(times)
        share = "" if peak is None else f"{operations / median / peak:>8.1%} of the bf16 peak"
        print(f"  {way:<34}{median * 1e3:>10.1f} ms{first / median:>8.2f}× as fast{share}")


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


if __name__ == "__main__":
    main()
