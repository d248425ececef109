"""Work on many files: a progress bar, and errors that do not stop the others."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, TypeVar

from datamodules.core.progress import progress_bar
from tangent_train.errors import DataError, SettingError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping
    from pathlib import Path

__all__ = ["each"]

_Result = TypeVar("_Result")
_Item = TypeVar("_Item")


def each(
    description: str,
    items: Mapping[_Item, Path],
    work: Callable[[_Item, Path, Callable[[float], object]], _Result],
) -> Iterator[tuple[_Item, _Result | None, str]]:
    """Do some work for every item, with its rate and the time left on a bar.

    Args:
        description: Of the work.
        items: Files by item.
        work: Takes an item, its file, and a function to call with the share of the work done
            since the last call.

    Yields:
        The item with its result and no error, or with None and the error, which has been printed.
    """
    begun = time.monotonic()
    with progress_bar() as bar:
        task = bar.add_task(description, total=len(items), rate="")
        for number, (item, path) in enumerate(items.items(), start=1):
            try:
                yield item, work(item, path, lambda share: bar.advance(task, share)), ""
            except (DataError, SettingError, MemoryError) as error:
                message = str(error) if str(path) in str(error) else f"{path}: {error}"
                bar.console.print(message, style="red", markup=False, soft_wrap=True)
                yield item, None, message
            rate = f"{number / (time.monotonic() - begun):.2f}/s"
            bar.update(task, completed=number, rate=rate)
