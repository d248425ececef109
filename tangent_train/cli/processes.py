"""Runs as processes: their command lines, and waiting for them."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NoReturn

from tangent_train.cli.compose import quoted

_NOTICE_S = 3.0
"""After an interrupt, in which a process ends that a terminal's Ctrl-C has reached too."""

_PATIENCE_S = 30.0  # for a last checkpoint
_WATCHED_EVERY_S = 1.0
_FIRST = "TANGENT_TRAIN_FIRST_PROCESS"


class SigtermError(KeyboardInterrupt):
    """SIGTERM, by which everything ends as by Ctrl-C."""


def command_line(command: str, arguments: Sequence[str], folder: Path) -> list[str]:
    """Return the command line of one run.

    Args:
        command: train, evaluate, …
        arguments: Options, then overrides.
        folder: Folder of the run.
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


def end_with_first_process() -> None:
    """End this process with the first one of its run, which has started it.

    Lightning starts the other processes of a run on several devices, and ends the first one when
    one of them fails. A first process that was killed cannot end them: they would wait for it as
    long as for a slow one, up to an hour.
    """
    first = os.environ.get(_FIRST)
    if first is None or int(os.environ.get("LOCAL_RANK", "0")) == 0:
        os.environ[_FIRST] = str(os.getpid())
        return

    def watch() -> NoReturn:
        while os.getppid() == int(first):
            time.sleep(_WATCHED_EVERY_S)
        sys.stderr.write("tangent-train: ended, because the first process of the run has ended\n")
        sys.stderr.flush()
        os._exit(1)  # at once, also while another thread waits in a library

    threading.Thread(target=watch, daemon=True).start()


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
