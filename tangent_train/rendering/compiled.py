"""Loops that numba compiles, and the threads they run on.

Compiled loops are serial and release the GIL; `over_rows` runs them on several threads. Numba's own
parallel loops are not used: its OpenMP layer kills worker processes forked after its first use, its
portable layer dies when two threads use it at once.

Compiled code is cached in a folder of the user that is named after the content of its source file,
so a loop must not call compiled functions of another file. The cache holds pickles: the folder has
to be private. Without one, loops are compiled in every process.
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
"""Pixels for which starting a thread pays."""


class _Restrict(Compiler):  # type: ignore[misc]
    """Compiles as C does with ``restrict``: arrays that are written overlap no other argument.

    Without it, a loop over the scores of one pixel takes longer to check that than to add them.
    """

    def define_pipelines(self) -> list[Any]:
        self.state.flags.noalias = True
        return super().define_pipelines()


def cache_folder() -> Path | None:
    """The folder for compiled code, in ``NUMBA_CACHE_DIR`` or else in the user's cache.

    Returns:
        None if it cannot be written to, or other users have access to it.
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
        # Numba unpickles the code of another version before it finds that it is outdated.
        source = Path(function.__code__.co_filename).read_bytes()
        users, config.CACHE_DIR = config.CACHE_DIR, str(_CACHE / f"{crc32(source):08x}")
        loop.enable_caching()
        config.CACHE_DIR = users
    return loop


def over_rows(kernel: Callable[..., None], rows: int, width: int, *arguments: Any) -> None:
    """Run ``kernel(start, stop, *arguments)`` over all rows, in parallel blocks.

    Uses as many threads as torch would (`torch.get_num_threads`: one inside a `DataLoader` worker),
    and none for little work. They end with the call, so processes may fork before and after.

    Args:
        kernel: A compiled function that releases the GIL.
        rows: Number of rows.
        width: Pixels in a row.
        *arguments: What the kernel takes besides the rows.
    """
    threads = min(torch.get_num_threads(), rows, rows * width // _SMALLEST_SHARE)
    if threads <= 1:
        kernel(0, rows, *arguments)
        return
    # Several blocks per thread: rows near the poles take longer or shorter than others.
    blocks = min(8 * threads, rows)
    edges = [rows * block // blocks for block in range(blocks + 1)]
    with ThreadPoolExecutor(threads) as pool:
        runs = [pool.submit(kernel, start, stop, *arguments) for start, stop in pairwise(edges)]
        for run in runs:
            run.result()
