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
