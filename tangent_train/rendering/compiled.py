"""Compile loops with numba, and run them on several threads.

Compiled loops are serial and release the GIL; `over_rows` runs them on several threads. Numba's own
parallel loops are not used: its OpenMP layer kills worker processes forked after its first use, and
its portable layer crashes when two threads use it at once.

Compiled code is cached in a folder named after a checksum of its source file, so a loop must not
call compiled functions of another file. The cache contains pickles, so only the user may have
access to the folder. If that cannot be ensured, loops are compiled in every process.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any, TypeVar
from zlib import crc32

import torch
from numba import config, njit
from numba.core.compiler import Compiler

from tangent_train.imports import is_private

config._config_fname = ""  # numba would read .numba_config.yaml here at every compilation

Function = TypeVar("Function", bound=Callable[..., Any])

_SMALLEST_SHARE = 2**15
"""Number of pixels from which another thread saves time."""


class _Restrict(Compiler):  # type: ignore[misc]
    """A compiler that assumes, like ``restrict`` in C, that arguments do not overlap in memory.

    Otherwise a loop over the scores of one pixel spends more time on checking than on adding.
    """

    def define_pipelines(self) -> list[Any]:
        self.state.flags.noalias = True
        return super().define_pipelines()


def cache_folder() -> Path | None:
    """Return the folder for compiled code, in ``NUMBA_CACHE_DIR`` or else in the user's cache.

    Returns:
        The folder; None if it cannot be written, or if other users have access to it.
    """
    with suppress(OSError, RuntimeError):  # no home
        users = Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser()
        folder = Path(os.environ.get("NUMBA_CACHE_DIR") or users).absolute() / "tangent-train"
        folder.mkdir(0o700, parents=True, exist_ok=True)
        TemporaryFile(dir=folder).close()
        if is_private(folder):
            return folder
    return None


_CACHE = cache_folder()


def njit_exact(function: Function) -> Function:
    """Compile with IEEE arithmetic."""
    return _compiled(function)


def njit_fast(function: Function) -> Function:
    """Compile with reordered arithmetic; infinities and NaN keep their meaning.

    Arrays that the function writes must not overlap its other arguments.
    """
    flags = {"contract", "reassoc", "nsz", "arcp"}
    return _compiled(function, fastmath=flags, pipeline_class=_Restrict)


def _compiled(function: Function, **settings: Any) -> Function:
    loop = njit(nogil=True, error_model="numpy", **settings)(function)
    if _CACHE is not None:
        # A folder for each version of the file: numba unpickles outdated code before it checks it.
        source = Path(function.__code__.co_filename).read_bytes()
        users, config.CACHE_DIR = config.CACHE_DIR, str(_CACHE / f"{crc32(source):08x}")
        loop.enable_caching()
        config.CACHE_DIR = users
    return loop


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
