"""Compiled kernels on several threads."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from typing import Any

import torch

__all__ = ["over_rows"]


def over_rows(
    kernel: Callable[..., None],
    shape: tuple[int, int],
    *arguments: Any,
    smallest_share: int = 2**15,
) -> None:
    """Run ``kernel(start, stop, *arguments)`` over all rows, in parallel blocks.

    As many threads as torch would use (`torch.get_num_threads`: one inside a `DataLoader` worker),
    and none for small work. They end with the call, so processes may fork before and after.

    Args:
        kernel: A compiled function that releases the GIL.
        shape: ``(H, W)`` rows and their length.
        *arguments: What the kernel takes besides the rows.
        smallest_share: Pixels for which starting a thread is worth it.
    """
    height, width = shape
    threads = min(torch.get_num_threads(), height, height * width // smallest_share)
    if threads <= 1:
        kernel(0, height, *arguments)
        return
    # Several blocks per thread: rows near the poles take longer or shorter than others.
    blocks = min(8 * threads, height)
    edges = [height * block // blocks for block in range(blocks + 1)]
    with ThreadPoolExecutor(threads) as pool:
        runs = [pool.submit(kernel, start, stop, *arguments) for start, stop in pairwise(edges)]
        for run in runs:
            run.result()
