"""Decorators for loops that numba compiles.

Compiled loops are serial and release the GIL; `tangent_train.rendering.threads.over_rows` runs
the ones that take ``(start, stop)`` rows on several threads. Numba's own parallel loops are not
used: its OpenMP layer kills worker processes forked after its first use, its portable layer dies
when two threads use it at once.

Compiled code is kept on disk beside each source file and checked against that file alone: a loop
must not call compiled functions of another file.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

from numba import njit

__all__ = ["njit_exact", "njit_fast"]

Function = TypeVar("Function", bound=Callable[..., Any])


def njit_exact(function: Function) -> Function:
    """Compile with IEEE arithmetic."""
    compiled: Function = njit(cache=True, nogil=True, error_model="numpy")(function)
    return compiled


def njit_fast(function: Function) -> Function:
    """Compile with reordered arithmetic; infinities and NaN keep their meaning."""
    flags = {"contract", "reassoc", "nsz", "arcp"}
    compiled: Function = njit(cache=True, nogil=True, error_model="numpy", fastmath=flags)(function)
    return compiled
