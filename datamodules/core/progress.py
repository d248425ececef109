"""Progress bars of work on files."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

if TYPE_CHECKING:
    from collections.abc import Iterable

__all__ = ["progress_bar", "show_progress"]


def progress_bar(*, show: bool = True) -> Progress:
    """A bar for tasks with a field `rate`.

    Args:
        show: Whether to show anything.
    """
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[rate]}"),
        TimeRemainingColumn(),
    )
    return Progress(*columns, disable=not show)


def show_progress(
    done: Iterable[object],
    description: str,
    unit: str,
    total: int,
    *,
    before: int = 0,
    show: bool = True,
) -> None:
    """Consume finished pieces of work and show the progress.

    Args:
        done: Yields something whenever a piece is done.
        description: Description of the work.
        unit: Pieces, in the plural.
        total: Number of pieces.
        before: Pieces that were done before.
        show: Whether to show anything.
    """
    with progress_bar(show=show) as bar:
        task = bar.add_task(description, total=total, rate="")
        bar.advance(task, before)
        for _ in done:
            speed = bar.tasks[task].speed
            bar.update(task, advance=1, rate=f"{speed:.1f} {unit}/s" if speed else "")
