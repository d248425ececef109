"""Work in several processes; after an interrupt, started work is finished."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from multiprocessing import connection, forkserver
from typing import Any, TypeVar

import cv2

_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
_Result = TypeVar("_Result")


def in_processes(
    work: Callable[..., _Result],
    pieces: Sequence[tuple[Any, ...]],
    workers: int | None = None,
    least: int = 1,
) -> Generator[_Result]:
    """Yield ``work(*piece)`` for all pieces, in the order of completion.

    After an interrupt, started pieces are finished and no others are started.

    Args:
        work: A function of a module.
        pieces: Arguments of the function for each piece of work.
        workers: Number of processes, by default one per CPU core; 0 and 1 mean this process.
        least: Smallest number of pieces that justifies starting a process.
    """
    cores = os.cpu_count() or 1
    processes = min(cores if workers is None else workers, -(-len(pieces) // least))
    if processes <= 1:
        for piece in pieces:
            yield work(*piece)
        return
    methods = multiprocessing.get_all_start_methods()
    context = multiprocessing.get_context("forkserver" if "forkserver" in methods else "spawn")
    context.set_forkserver_preload([work.__module__])  # imported once, not once per process
    with _one_thread_each(), ProcessPoolExecutor(processes, context, _prepare_worker) as pool:
        try:
            if "forkserver" in methods:
                forkserver.ensure_running()
            futures = [pool.submit(work, *piece) for piece in pieces]
            for future in as_completed(futures):
                yield future.result()
        finally:
            pool.shutdown(cancel_futures=True)


@contextmanager
def _one_thread_each() -> Iterator[None]:
    """Limit child processes started in this context to one linear algebra thread each."""
    before = {name: os.environ.get(name) for name in _THREADS}
    os.environ.update(dict.fromkeys(_THREADS, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name)
            else:
                os.environ[name] = value


def _prepare_worker() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent handles interrupts
    cv2.setNumThreads(1)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """End this worker when its parent ends; otherwise it would wait for work forever."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        connection.wait([parent.sentinel])
        os._exit(1)
