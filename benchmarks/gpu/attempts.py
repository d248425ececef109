"""The device, and measurements that may fail: what fails is told, and the others go on."""

from __future__ import annotations

import functools
import gc
import math
import subprocess
import time
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import torch
from torch import nn

from benchmarks.measuring import Table, Way, memory_kib
from tangent_train.cli.processes import command_line, run_process

__all__ = [
    "DEVICE",
    "FAILURES",
    "QUICK",
    "Attempts",
    "device_facts",
    "part",
    "peak_mib",
    "run_command",
    "segformer",
    "way",
]

DEVICE = torch.device("cuda" if torch.cuda.is_available() else "cpu")
"""Without a GPU everything runs on the CPU at toy size, to try the code; figures mean nothing."""

QUICK = DEVICE.type == "cpu"

FAILURES: list[str] = []
"""What failed or was left out, and why; in the results."""

Part = Callable[["Attempts"], Iterator[Table]]


class Attempts:
    """The measurements of one part.

    Args:
        seconds: After these nothing new is begun.
        quick: Toy size.
    """

    def __init__(self, seconds: float, quick: bool) -> None:
        self.quick = quick
        self._start, self._seconds = time.perf_counter(), math.inf if quick else seconds

    def tried(self, name: str, call: Callable[[], Any], takes_s: float = 0) -> Any:
        """The result of a measurement; None if it failed or would take more time than is left."""
        elapsed = time.perf_counter() - self._start
        if elapsed + takes_s > self._seconds:
            FAILURES.append(f"{name}: left out after {elapsed:.0f} s, for about {takes_s:.0f} s")
            return None
        print(f"  [{elapsed:4.0f} s] {name} …", flush=True)
        try:
            return call()
        except Exception as error:
            traceback.print_exc()
            FAILURES.append(f"{name}: {type(error).__name__}: {error}")
            return None
        finally:
            gc.collect()
            torch.cuda.empty_cache()


def part(seconds: float) -> Callable[[Part], Callable[[bool], Iterator[Table]]]:
    """Make a function of `Attempts` a benchmark, whose error does not end the other ones."""

    def decorate(measure: Part) -> Callable[[bool], Iterator[Table]]:
        @functools.wraps(measure)
        def run(quick: bool) -> Iterator[Table]:
            try:
                yield from measure(Attempts(seconds, quick))
            except Exception as error:
                traceback.print_exc()
                FAILURES.append(f"{measure.__name__}: {type(error).__name__}: {error}")

        return run

    return decorate


def way(name: str, call: Callable[[], object], repeats: int = 1, **more: Any) -> Way:
    """A way that is timed until the device has done its work, `repeats` times."""

    def run() -> None:
        for _ in range(repeats):
            call()
        if DEVICE.type == "cuda":
            torch.cuda.synchronize()

    return Way(name, run, scale=1 / repeats, **more)


def peak_mib(call: Callable[[], object]) -> float:
    """Memory that a call adds at most; on a CPU, of its result and nothing it frees."""
    if DEVICE.type == "cpu":
        before = memory_kib("VmRSS")
        call()
        return max(1, memory_kib("VmHWM") - before) / 2**10
    torch.cuda.synchronize()
    torch.cuda.reset_peak_memory_stats()
    before = torch.cuda.memory_allocated()
    call()
    torch.cuda.synchronize()
    return (torch.cuda.max_memory_allocated() - before) / 2**20


def device_facts() -> dict[str, Any]:
    """Name and versions."""
    if DEVICE.type == "cpu":
        return {"device": "no GPU: toy size on the CPU, figures mean nothing"}
    query = ["nvidia-smi", "--query-gpu=driver_version", "--format=csv,noheader"]
    driver = subprocess.run(query, capture_output=True, text=True, check=False).stdout.strip()
    memory = torch.cuda.get_device_properties(DEVICE).total_memory / 2**30
    name = f"{torch.cuda.get_device_name()}, {memory:.0f} GiB"
    return {"device": name, "cuda": torch.version.cuda, "driver": driver or "unknown"}


def segformer(num_classes: int, *, quick: bool) -> nn.Module:
    """SegFormer-B0, untrained; smaller if `quick`."""
    from models import HuggingFaceNetwork

    config: dict[str, Any] = {"model_type": "segformer"}
    if quick:
        config |= {"hidden_sizes": [8, 8, 16, 16], "num_attention_heads": [1, 1, 2, 2]}
        config |= {"depths": [1, 1, 1, 1], "decoder_hidden_size": 16}
    return HuggingFaceNetwork(config, num_classes)


def run_command(command: str, arguments: list[str], folder: Path) -> bool:
    """Run a command of this project in a process of its own."""
    status = run_process(command_line(command, arguments, folder))
    if status:
        raise RuntimeError(f"tangent-{command} ended with status {status}")
    return True
