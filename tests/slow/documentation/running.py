"""Documented commands, run for real, in processes that have imported what is slow to import.

A server imports it once; every command is a process forked from it. The runs that a sweep or a
transfer starts are forked in turn.
"""

from __future__ import annotations

import importlib
import multiprocessing
import os
import runpy
import sys
import tempfile
import threading
import tomllib
import traceback
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).resolve().parents[3]
PATIENCE_S = 300
_SLOW_IMPORTS = [
    "pytest",
    "tangent_train.cli.run",
    "tangent_train.cli.transfer.command",
    "matplotlib.figure",
]
_SCRIPTS = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]


class Done(NamedTuple):
    """What a command left.

    Attributes:
        status: 0 when all went well.
        output: All that it printed.
    """

    status: int | None
    output: str


def run(words: Sequence[str], variables: Mapping[str, str], folder: Path) -> Done:
    """Run a console script of this project, or Python, and wait for it.

    Args:
        words: Program and arguments.
        variables: Environment variables to set.
        folder: To run in.

    Returns:
        The status is None when it did not end in time.
    """
    context = multiprocessing.get_context("forkserver")
    with pytest.MonkeyPatch.context() as patch:
        # For the server, which starts with the first command: forked processes have no threads.
        patch.setenv("OMP_NUM_THREADS", "1")
        patch.setenv("NUMBA_NUM_THREADS", "1")
        context.set_forkserver_preload(_SLOW_IMPORTS)
        with tempfile.NamedTemporaryFile() as log:
            process = context.Process(
                target=_command, args=(list(words), dict(variables), str(folder), log.name)
            )
            process.start()
            process.join(PATIENCE_S)
            status = process.exitcode
            if status is None:
                process.kill()
                process.join()
            return Done(status, Path(log.name).read_text(errors="replace"))


def _command(words: list[str], variables: dict[str, str], folder: str, log: str) -> None:
    # What runs here is covered by other tests: tracing it takes five times as long.
    sys.settrace(None)
    threading.settrace(None)
    with Path(log).open("wb") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    sys.stdout = open(1, "w", encoding="utf-8", closefd=False)  # noqa: SIM115
    sys.stderr = open(2, "w", encoding="utf-8", closefd=False)  # noqa: SIM115
    os.chdir(folder)
    os.environ.update({"COLUMNS": "120", **variables})
    added = [str(Path(p).absolute()) for p in variables.get("PYTHONPATH", "").split(":") if p]
    sys.path[:0] = added
    importlib.invalidate_caches()
    _fork_further_runs()
    status = _status_of(words)
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(status)


def _status_of(words: list[str]) -> int:
    """Run it here; what a shell would say of it."""
    program, *arguments = words
    try:
        if program in ("python", "python3"):
            _python(arguments)
        else:
            module, _, function = _SCRIPTS[program].partition(":")
            sys.argv = [str(Path(sys.executable).with_name(program)), *arguments]
            getattr(importlib.import_module(module), function)()
    except SystemExit as stopped:
        if stopped.code is None or isinstance(stopped.code, int):
            return stopped.code or 0
        sys.stderr.write(f"{stopped.code}\n")
        return 1
    except BaseException:
        traceback.print_exc()
        return 1
    return 0


def _python(arguments: list[str]) -> None:
    if arguments[0] == "-m":
        sys.argv = arguments[1:]
        sys.path.insert(0, str(ROOT))  # the benchmarks are no part of the package
        runpy.run_module(arguments[1], run_name="__main__", alter_sys=True)
    else:
        sys.argv = arguments
        runpy.run_path(arguments[0], run_name="__main__")


def _fork_further_runs() -> None:
    """Replace new interpreters, seconds each, in what starts runs of this project."""
    from tangent_train.cli import sweep
    from tangent_train.cli.transfer import stage_runs

    started = 0

    def job(line: Sequence[str], environment: dict[str, str]) -> tuple[int, list[str]]:
        # The first job of a sweep runs; of the second it is seen that its settings exist.
        nonlocal started
        started += 1
        if started > 2:
            return 0, []
        return _forked([*line, *(["--cfg", "job"] if started > 1 else [])], environment)

    for module, replacement in ((sweep, job), (stage_runs, _forked)):
        setattr(module, "run_process", replacement)  # noqa: B010 - not to be found by its name


def _forked(line: Sequence[str], environment: dict[str, str]) -> tuple[int, list[str]]:
    from hydra.core.global_hydra import GlobalHydra

    python, as_module, module, command, *arguments = line
    assert (python, as_module, module) == (sys.executable, "-m", "tangent_train.cli.main")
    sys.stdout.flush()
    sys.stderr.flush()
    child = os.fork()
    if child == 0:
        os.environ.clear()
        os.environ.update(environment)
        GlobalHydra.instance().clear()
        status = _status_of([f"tangent-{command}", *arguments])
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), []
