"""Runs as processes: their command lines, and waiting for them.

Lightning starts a process per device with the command line it finds: that has to be the command
line of one run. So what consists of several runs, a sweep or a transfer, starts a process for each.
"""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from collections import deque
from contextlib import contextmanager
from typing import TYPE_CHECKING, NoReturn

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

__all__ = ["command_line", "ended_by_sigterm", "run_environment", "run_process"]

_PATIENCE_S = 30.0  # for a last checkpoint
_LINES_OF_AN_ERROR = 12
_NEEDS_NO_QUOTES = re.compile(r"[\w/.+-]+")  # in an override


def command_line(command: str, arguments: Sequence[str], folder: Path) -> list[str]:
    """The command line of one run.

    Args:
        command: train, evaluate or prepare.
        arguments: Options and overrides.
        folder: Of the run.
    """
    path = str(folder)
    if not _NEEDS_NO_QUOTES.fullmatch(path):
        path = "'" + path.replace("'", r"\'") + "'"
    program = [sys.executable, "-m", "tangent_train.cli.main"]
    return [*program, command, *arguments, f"hydra.run.dir={path}"]


def run_environment() -> dict[str, str]:
    """The environment of a run.

    Not the working folder on Python's path, as with the console scripts: a folder "models" in it
    would be imported. A variable, because it has to reach the processes Lightning starts.
    """
    return {**os.environ, "PYTHONSAFEPATH": "1"}


def run_process(line: Sequence[str], environment: dict[str, str]) -> tuple[int, list[str]]:
    """Run to the end; output is passed on.

    When this process is interrupted or ended, so is that one.

    Args:
        line: Program and arguments.
        environment: All of its variables.

    Returns:
        The exit status and the last lines of the standard error.
    """
    last: deque[str] = deque(maxlen=_LINES_OF_AN_ERROR)
    with (
        ended_by_sigterm(),
        subprocess.Popen(
            line, env=environment, stderr=subprocess.PIPE, text=True, errors="replace"
        ) as process,
    ):
        try:
            for text in process.stderr or ():
                sys.stderr.write(text)
                sys.stderr.flush()
                last.append(text.rstrip())
            return process.wait(), list(last)
        except BaseException as error:
            _stop(process, told=isinstance(error, KeyboardInterrupt))
            raise


def _stop(process: subprocess.Popen[str], *, told: bool) -> None:
    """End the process, gently first: a terminal's Ctrl-C has already told it."""
    try:
        if not told:
            process.terminate()
        for insist in (process.terminate, process.kill):
            try:
                # Reads on, or a full pipe would keep the process from ending.
                sys.stderr.write(process.communicate(timeout=_PATIENCE_S)[1] or "")
            except subprocess.TimeoutExpired:
                insist()
            else:
                return
    except BaseException:
        process.kill()
        raise


@contextmanager
def ended_by_sigterm() -> Iterator[None]:
    """Let SIGTERM unwind this process as Ctrl-C does, rather than end it at once."""

    def leave(number: int, frame: object) -> NoReturn:
        sys.exit(128 + number)

    before = signal.signal(signal.SIGTERM, leave)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
