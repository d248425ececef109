"""Progress of work on files: bars on a terminal, a line a minute elsewhere."""

from __future__ import annotations

import time
from collections.abc import Iterable
from typing import Any

from rich import get_console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeRemainingColumn,
)

__all__ = ["PlainLines", "progress_bar", "show_progress"]

_EVERY_S = 60.0


class PlainLines:
    """Lines of progress where the output is no terminal: at most one a minute."""

    def __init__(self) -> None:
        self._last = time.monotonic()

    def tell(self, line: str, *, at_once: bool = False) -> None:
        """Print a line, if it is time for one.

        Args:
            line: Without its end.
            at_once: Whether it is not to wait.
        """
        console = get_console()
        if console.is_terminal or not (at_once or time.monotonic() - self._last >= _EVERY_S):
            return
        self._last = time.monotonic()
        console.print(line, markup=False, highlight=False, soft_wrap=True)


class _Progress(Progress):
    """A bar, or lines."""

    def __init__(self, *columns: Any, **settings: Any) -> None:
        self._lines = PlainLines()
        super().__init__(*columns, **settings)

    def update(self, task_id: TaskID, **changes: Any) -> None:
        super().update(task_id, **changes)
        task = self.tasks[task_id]
        told = f"{task.description}: {task.completed:g} of {task.total:g}"
        self._lines.tell(f"{told}, {task.fields['rate']}")


def progress_bar() -> Progress:
    """A bar for tasks with a field `rate`."""
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[rate]}"),
        TimeRemainingColumn(),
    )
    return _Progress(*columns, disable=not get_console().is_terminal)


def show_progress(
    done: Iterable[object],
    description: str,
    unit: str,
    total: int,
    before: int = 0,
) -> None:
    """Consume finished pieces of work and show the progress, unless all were done before.

    Args:
        done: Yields something whenever a piece is done.
        description: Description of the work.
        unit: Pieces, in the plural.
        total: Number of pieces.
        before: Pieces that were done before.
    """
    if before == total:
        return
    with progress_bar() as bar:
        task = bar.add_task(description, total=total, rate="")
        bar.advance(task, before)
        for _ in done:
            speed = bar.tasks[task].speed
            bar.update(task, advance=1, rate=f"{speed:.1f} {unit}/s" if speed else "")
