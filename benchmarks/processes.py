"""Processes of their own for measurements, some at once, which end when this one is told to."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections import deque
from collections.abc import Callable
from contextlib import contextmanager
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

__all__ = ["ONE_THREAD", "Finished", "Process", "interrupted_by_signals", "run_processes"]

ONE_THREAD = {"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}
"""Environment of a process that computes in one thread."""

_POLL_S = 0.1


class Process(NamedTuple):
    """One of them.

    Attributes:
        name: What it does, for people.
        arguments: Of Python.
        log: File for what it prints.
    """

    name: str
    arguments: tuple[str, ...]
    log: Path


Finished = Callable[[Process, int, float], None]
"""Told of a process that has ended: its status, and the seconds it took."""


class _Running(NamedTuple):
    process: Process
    started: subprocess.Popen[bytes]
    start_s: float


def run_processes(
    processes: Sequence[Process],
    at_once: int,
    finished: Finished,
    environment: dict[str, str] | None = None,
) -> None:
    """Run Python processes; none is left when this returns or raises.

    Args:
        processes: They, in the order they begin.
        at_once: How many.
        finished: Told of each that has ended.
        environment: Variables to set.
    """
    waiting, running = deque(processes), list[_Running]()
    try:
        while waiting or running:
            while waiting and len(running) < at_once:
                running.append(_started(waiting.popleft(), environment or {}))
            time.sleep(_POLL_S)
            for one in [one for one in running if one.started.poll() is not None]:
                running.remove(one)
                finished(one.process, one.started.returncode, time.perf_counter() - one.start_s)
    finally:
        for one in running:
            os.killpg(one.started.pid, signal.SIGKILL)  # whatever it writes, it writes atomically
            one.started.wait()


def _started(process: Process, environment: dict[str, str]) -> _Running:
    process.log.parent.mkdir(parents=True, exist_ok=True)
    with process.log.open("wb") as log:
        started = subprocess.Popen(
            [sys.executable, *process.arguments],
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=subprocess.STDOUT,
            env=os.environ | environment,
            start_new_session=True,  # a Ctrl-C is for this process, which ends the others
        )
    return _Running(process, started, time.perf_counter())


@contextmanager
def interrupted_by_signals() -> Iterator[None]:
    """Make SIGTERM and a closed terminal a `KeyboardInterrupt`, as Ctrl-C always is here."""
    signals = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    before = {number: signal.signal(number, signal.default_int_handler) for number in signals}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
