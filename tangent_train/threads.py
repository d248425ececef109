"""Work on many items in threads: OpenCV, zlib, Pillow, libav and compiled loops free the GIL."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")


def in_threads(
    work: Callable[[_Item], _Result],
    items: Iterable[_Item],
    workers: int | None = None,
    ahead: int | None = None,
) -> Generator[_Result]:
    """Results of some work on each item, in order.

    Items are taken in the thread that asks for results, which is thus one stage of a pipeline if
    the items themselves are made one by one. An error of the work comes in the place of its result;
    one of the items comes after the results of those before it. Closing drops what has not begun.

    Args:
        work: Called in other threads.
        items: Taken as they are needed.
        workers: Number of threads; None for one per core.
        ahead: Most items between who makes them and who asks for results, which bounds the memory;
            None for four per thread.
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
