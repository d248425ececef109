"""Compile loops with numba, and run them on several threads.

Compiled loops are serial and release the GIL; `over_rows` runs them on several threads. Numba's own
parallel loops are not used: its OpenMP layer kills worker processes forked after its first use, and
its portable layer crashes when two threads use it at once.

Numba caches compiled code by the source file of a loop, so a loop must not call compiled functions
of another file.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from itertools import pairwise
from typing import Any

import torch
from numba import njit
from numba.core.compiler import Compiler

_SMALLEST_SHARE = 2**15
"""Number of pixels from which another thread saves time."""


class _Restrict(Compiler):  # type: ignore[misc]
    """A compiler that assumes, like ``restrict`` in C, that arguments do not overlap in memory.

    Otherwise a loop over the scores of one pixel spends more time on checking than on adding.
    """

    def define_pipelines(self) -> list[Any]:
        self.state.flags.noalias = True
        return super().define_pipelines()


njit_exact: Any = partial(njit, nogil=True, cache=True, error_model="numpy")
"""Compiles with IEEE arithmetic."""

njit_fast: Any = partial(
    njit_exact, fastmath={"contract", "reassoc", "nsz", "arcp"}, pipeline_class=_Restrict
)
"""Compiles with reordered arithmetic; infinities and NaN keep their meaning.

Arrays that the function writes must not overlap its other arguments.
"""


def over_rows(kernel: Callable[..., None], rows: int, width: int, *arguments: Any) -> None:
    """Run ``kernel(start, stop, *arguments)`` on blocks of rows, in parallel.

    Uses as many threads as torch (`torch.get_num_threads`, which is 1 in a `DataLoader` worker),
    and no threads for small images. The threads end with the call, so that processes may fork
    before and after it.

    Args:
        kernel: A compiled function that releases the GIL.
        rows: Number of rows.
        width: Pixels in a row.
        *arguments: Other arguments of the kernel.
    """
    threads = min(torch.get_num_threads(), rows, rows * width // _SMALLEST_SHARE)
    if threads <= 1:
        kernel(0, rows, *arguments)
        return
    # Several blocks per thread, because rows near the poles do not take as long as others.
    blocks = min(8 * threads, rows)
    edges = [rows * block // blocks for block in range(blocks + 1)]
    with ThreadPoolExecutor(threads) as pool:
        runs = [pool.submit(kernel, start, stop, *arguments) for start, stop in pairwise(edges)]
        for run in runs:
            run.result()
