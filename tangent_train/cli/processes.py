"""Start runs as processes and wait for them."""

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
"""Time after Ctrl-C, which a terminal sends to all processes, for a process to end by itself."""

_CHECKPOINT_S = 30.0
"""Time after SIGTERM for a process to save a last checkpoint."""

_WATCHED_EVERY_S = 1.0
_FIRST = "TANGENT_TRAIN_FIRST_PROCESS"


class SigtermError(KeyboardInterrupt):
    """SIGTERM, which ends a command in the same way as Ctrl-C."""


def command_line(command: str, arguments: Sequence[str], folder: Path) -> list[str]:
    """Return the command line of one run.

    Args:
        command: Name of the command, e.g. train.
        arguments: Options and overrides.
        folder: Run folder.
    """
    program = [sys.executable, "-m", "tangent_train.cli.main"]
    return [*program, command, *arguments, f"hydra.run.dir={quoted(str(folder))}"]


def run_process(line: Sequence[str], changes: Mapping[str, str | None] | None = None) -> int:
    """Run a command and wait for it; Ctrl-C and SIGTERM of this process end it too.

    Args:
        line: Program and arguments.
        changes: Environment variables to set, or to remove (None).

    Returns:
        Exit status of the command.
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
                    process.wait(_CHECKPOINT_S)
            finally:
                process.kill()
                process.wait()
            raise


def end_with_first_process() -> None:
    """End this process when the first process of its run, which has started it, has ended.

    On several devices, Lightning's first process starts the others, and ends when one of them
    fails. If the first process is killed, the others would wait for it for up to an hour.
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
        os._exit(1)  # immediately, even if another thread waits in a library

    threading.Thread(target=watch, daemon=True).start()


@contextmanager
def ended_by_sigterm() -> Iterator[None]:
    """Raise `SigtermError` on SIGTERM instead of ending the process immediately."""

    def leave(number: int, frame: object) -> NoReturn:
        raise SigtermError

    before = signal.signal(signal.SIGTERM, leave)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
