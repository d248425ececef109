"""Progress bars of work on files, on a terminal only."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rich import get_console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

if TYPE_CHECKING:
    from collections.abc import Iterable

__all__ = ["progress_bar", "show_progress"]


def progress_bar() -> Progress:
    """A bar for tasks with a field `rate`."""
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[rate]}"),
        TimeRemainingColumn(),
    )
    return Progress(*columns, disable=not get_console().is_terminal)


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
