"""Progress of work on files: a bar on a terminal, a line per minute elsewhere."""

from __future__ import annotations

import time
from collections.abc import Iterable
from datetime import timedelta
from typing import Any

from rich import get_console
from rich.progress import BarColumn, Progress, TaskID, TimeRemainingColumn

_EVERY_S = 60.0


class PlainLines:
    """Lines of progress for output that is not a terminal: at most one per minute."""

    def __init__(self) -> None:
        self._last = time.monotonic()

    def print(self, line: str, *, at_once: bool = False) -> None:
        """Print a line if the last one is a minute old.

        Args:
            line: Text without line end.
            at_once: True to print it in any case.
        """
        console, now = get_console(), time.monotonic()
        if not console.is_terminal and (at_once or now - self._last >= _EVERY_S):
            self._last = now
            console.print(line, markup=False, highlight=False, soft_wrap=True)


class _Progress(Progress):
    """Progress of one task, as a bar or as lines."""

    def __init__(self, *columns: Any, **settings: Any) -> None:
        self._lines, self._begun = PlainLines(), time.monotonic()
        super().__init__(*columns, **settings)

    def update(self, task_id: TaskID, **changes: Any) -> None:
        super().update(task_id, **changes)
        task = self.tasks[task_id]
        text, total = f"{task.description}: {task.completed:g} of {task.total:g}", task.total or 0
        done = task.completed - task.fields["before"]
        if done <= 0:
            self._lines.print(text, at_once=True)
            return
        each_s = (time.monotonic() - self._begun) / done
        rate = f"{60 / max(each_s, 1e-9):.3g}{task.fields['unit']}/min"
        super().update(task_id, rate=rate)
        # rich estimates from the last 30 seconds, in which possibly no piece was finished.
        left = timedelta(seconds=round(each_s * (total - task.completed)))
        self._lines.print(f"{text}, {rate}, {left} left")


def progress_bar() -> Progress:
    """Return a bar for a task with `unit`, `before` (pieces done earlier) and an empty `rate`."""
    texts = "{task.description}", "{task.completed:g}/{task.total:g}", "{task.fields[rate]}"
    columns = texts[0], BarColumn(), *texts[1:], TimeRemainingColumn()
    return _Progress(*columns, disable=not get_console().is_terminal)


def show_progress(
    done: Iterable[object], description: str, unit: str, total: int, before: int = 0
) -> None:
    """Consume finished pieces of work and show progress, unless all were done earlier.

    Args:
        done: Iterator that yields once per finished piece.
        description: Description of the work.
        unit: Name of the pieces, in the plural.
        total: Number of pieces.
        before: Number of pieces done earlier.
    """
    if before == total:
        return
    with progress_bar() as bar:
        fields: dict[str, Any] = {"unit": f" {unit}", "before": before, "rate": ""}
        task = bar.add_task(description, total=total, completed=before, **fields)
        bar.update(task)
        for _ in done:
            bar.update(task, advance=1)
