"""The device, and measurements that may fail: what fails is listed, and the others go on."""

from __future__ import annotations

import gc
import subprocess
import traceback
from collections.abc import Callable
from typing import Any

import torch
from torch import nn

from benchmarks.measuring import Way, memory_kib

__all__ = ["DEVICE", "FAILURES", "QUICK", "device_facts", "peak_mib", "segformer", "tried", "way"]

DEVICE = torch.device("cuda" if torch.cuda.is_available() else "cpu")
"""Without a GPU everything runs on the CPU at toy size, to try the code; figures mean nothing."""

QUICK = DEVICE.type == "cpu"

FAILURES: list[str] = []
"""What failed, and why; in the results."""


def tried(name: str, call: Callable[[], Any]) -> Any:
    """The result of a measurement; None if it failed."""
    print(f"  {name} …", flush=True)
    try:
        return call()
    except Exception as error:
        traceback.print_exc()
        FAILURES.append(f"{name}: {type(error).__name__}: {error}")
        return None
    finally:
        gc.collect()
        torch.cuda.empty_cache()


def way(name: str, call: Callable[[], object], repeats: int = 1, **more: Any) -> Way:
    """A way that is timed until the device has done its work, `repeats` times."""

    def run() -> None:
        for _ in range(repeats):
            call()
        if not QUICK:
            torch.cuda.synchronize()

    return Way(name, run, scale=1 / repeats, **more)


def peak_mib(call: Callable[[], object]) -> float:
    """Memory that a call adds at most; on a CPU, of its result and nothing it frees."""
    if QUICK:
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
    if QUICK:
        return {"device": "no GPU: toy size on the CPU, figures mean nothing"}
    query = ["nvidia-smi", "--query-gpu=driver_version", "--format=csv,noheader"]
    driver = subprocess.run(query, capture_output=True, text=True, check=False).stdout.strip()
    memory = torch.cuda.get_device_properties(DEVICE).total_memory / 2**30
    name = f"{torch.cuda.get_device_name()}, {memory:.0f} GiB"
    return {"device": name, "cuda": torch.version.cuda, "driver": driver or "unknown"}


def segformer(num_classes: int) -> nn.Module:
    """SegFormer-B0, untrained; smaller without a GPU."""
    from models import HuggingFaceNetwork

    config: dict[str, Any] = {"model_type": "segformer"}
    if QUICK:
        config |= {"hidden_sizes": [8, 8, 16, 16], "num_attention_heads": [1, 1, 2, 2]}
        config |= {"depths": [1, 1, 1, 1], "decoder_hidden_size": 16}
    return HuggingFaceNetwork(config, num_classes)
