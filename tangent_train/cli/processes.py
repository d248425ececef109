"""Runs as processes: their command lines, and waiting for them."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NoReturn

from tangent_train.cli.compose import quoted

_NOTICE_S = 3.0
"""After an interrupt, in which a process ends that a terminal's Ctrl-C has reached too."""

_PATIENCE_S = 30.0  # for a last checkpoint


class SigtermError(KeyboardInterrupt):
    """SIGTERM, by which everything ends as by Ctrl-C."""


def command_line(command: str, arguments: Sequence[str], folder: Path) -> list[str]:
    """The command line of one run.

    Args:
        command: train, evaluate, …
        arguments: Options, then overrides.
        folder: Of the run.
    """
    program = [sys.executable, "-m", "tangent_train.cli.main"]
    return [*program, command, *arguments, f"hydra.run.dir={quoted(str(folder))}"]


def run_process(line: Sequence[str], changes: Mapping[str, str | None] | None = None) -> int:
    """Run a command to the end; an interrupt or end of this process ends it too.

    Args:
        line: Program and arguments.
        changes: Environment variables to change, or to remove with None.

    Returns:
        The exit status.
    """
    environment = {**os.environ, **(changes or {})}
    known = {name: value for name, value in environment.items() if value is not None}
    with ended_by_sigterm(), subprocess.Popen(line, env=known) as process:
        try:
            return process.wait()
        except BaseException as error:
            try:
                with suppress(subprocess.TimeoutExpired):
                    process.wait(_NOTICE_S if type(error) is KeyboardInterrupt else 0)
                process.terminate()
                with suppress(subprocess.TimeoutExpired):
                    process.wait(_PATIENCE_S)
            finally:
                process.kill()
                process.wait()
            raise


@contextmanager
def ended_by_sigterm() -> Iterator[None]:
    """Let SIGTERM unwind this process like Ctrl-C instead of ending it at once."""

    def leave(number: int, frame: object) -> NoReturn:
        raise SigtermError

    before = signal.signal(signal.SIGTERM, leave)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
