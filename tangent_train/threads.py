"""Work on many items in threads, or in processes where the work holds the GIL.

OpenCV, zlib, Pillow, libav and compiled loops free it.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Generator, Iterable, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, ThreadPoolExecutor, as_completed
from multiprocessing.connection import wait
from typing import Any, TypeVar

_ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
"""Variables by which a process of many uses one thread for linear algebra."""

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")


def in_threads(
    work: Callable[[_Item], _Result],
    items: Iterable[_Item],
    workers: int | None = None,
    ahead: int | None = None,
) -> Generator[_Result]:
    """Work on items in threads; yield the results in order.

    Items are taken in the thread that iterates over the results, so that generators can form a
    pipeline. An error of the work is raised in place of its result, an error of the items after
    the results of earlier items. Closing cancels work that has not begun.

    Args:
        work: Function that is called in other threads.
        items: Items, taken as they are needed.
        workers: Number of threads; None for one per core.
        ahead: Largest number of items that have been taken but not yielded, which bounds the
            memory; None for four per thread.
    """
    workers = workers or os.cpu_count() or 1
    ahead = 4 * workers if ahead is None else ahead
    waiting: deque[Future[_Result]] = deque()
    source, ended, failed = iter(items), False, None
    pool = ThreadPoolExecutor(workers)
    try:
        while waiting or not ended:
            if not ended:
                try:
                    waiting.append(pool.submit(work, next(source)))
                except StopIteration:
                    ended = True
                except (Exception, KeyboardInterrupt) as error:
                    ended, failed = True, error
            if waiting and (ended or len(waiting) > ahead or waiting[0].done()):
                yield waiting.popleft().result()
        if failed is not None:
            raise failed
    finally:
        pool.shutdown(cancel_futures=True)


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
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(processes, context, _prepare_worker)
    before = dict(os.environ)
    os.environ.update(_ONE_THREAD)
    try:
        futures = [pool.submit(work, *piece) for piece in pieces]
        os.environ.clear()
        os.environ.update(before)
        for future in as_completed(futures):
            yield future.result()
    finally:
        pool.shutdown(cancel_futures=True)


def _prepare_worker() -> None:
    import cv2  # slow to import

    cv2.setNumThreads(1)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent handles interrupts
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """End this worker when its parent ends; otherwise it would wait for work forever."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)
