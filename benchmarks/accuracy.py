"""Accuracy at equal training time, on made rooms: ``python -m benchmarks accuracy``.

Every row is a network trained for the same time, with some seeds, and evaluated on the panoramas of
rooms not seen, upright and turned. What is done is kept in the output folder and not done again:
the same command goes on where it ended. How long an epoch takes is measured first, one row after
the other; rows then train for so many epochs, whatever else the machine does.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, get_args

from benchmarks.accuracy_folder import AccuracyFolder, Device, Plan, results_of
from benchmarks.accuracy_rows import ORIENTATIONS, PLAIN, ROWS, chosen_rows
from benchmarks.accuracy_table import found_lines, write_tables
from benchmarks.processes import (
    ONE_THREAD,
    Process,
    interrupted_by_signals,
    run_processes,
)
from tangent_train.errors import SettingError
from tangent_train.files import write_bytes

if TYPE_CHECKING:
    from collections.abc import Sequence

    from benchmarks.accuracy_rows import Row
    from benchmarks.processes import Finished

__all__ = ["main"]

_LOG_LINES = 5
_BUSY = 1.1
"""Time on the wall, beside that of the process, of a machine that others use as well."""


def main(arguments: list[str] | None = None) -> None:
    """Measure, train, evaluate what is not done yet, and write the table.

    Args:
        arguments: The command line.
    """
    options = _parser().parse_args(arguments)
    try:
        ablation = Ablation(options)
    except SettingError as error:
        sys.exit(f"accuracy: {error}")
    try:
        with interrupted_by_signals():
            ablation.run()
    except SettingError as error:
        sys.exit(f"accuracy: {error}")
    except KeyboardInterrupt:
        print(f"Interrupted. The same command goes on; {options.output} holds what is done.")
        sys.exit(130)
    if ablation.failed:
        sys.exit(f"accuracy: {len(ablation.failed)} failed: {', '.join(ablation.failed)}")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks accuracy",
        description=__doc__,
        epilog="rows: " + ", ".join(ROWS),
    )
    add = parser.add_argument
    add("--seconds", type=float, default=200, help="training time of every row (default 200)")
    add("--seeds", type=_count, default=3, help="trainings of every row (default 3)")
    add("--jobs", type=_count, help="at once, of one thread each (default 2, on a GPU 1)")
    add("--output", type=Path, default=Path("runs/accuracy"), help="folder for all that is made")
    add("--rows", default="", help="names, with commas between them (default all)")
    add("--level", type=_count, default=6, help="level s of the panoramas (default 6)")
    add("--rooms-height", type=_count, help="rows of the made rooms (default those of the level)")
    add("--device", choices=get_args(Device), default="cpu")
    add("settings", nargs="*", help="more settings of tangent-train for all rows, as data.fold=2")
    return parser


def _count(text: str) -> int:
    count = int(text)
    if count < 1:
        raise argparse.ArgumentTypeError(f"{text}: 1 or more")
    return count


class Ablation:
    """The course of the command.

    Args:
        options: Of the command line.

    Attributes:
        failed: Names of processes that failed.

    Raises:
        SettingError: A row does not exist, or the folder is that of another plan.
    """

    def __init__(self, options: argparse.Namespace) -> None:
        self.failed: list[str] = []
        self._rows = chosen_rows([name for name in options.rows.split(",") if name])
        self._seeds: int = options.seeds
        height = options.rooms_height or 2 ** (options.level + 1)
        self._plan = Plan(
            options.seconds, options.level, height, options.device, tuple(options.settings)
        )
        on_gpu = options.device == "cuda"
        self._jobs: int = options.jobs or (1 if on_gpu else 2)
        self._environment = {} if on_gpu else ONE_THREAD
        self._folder = AccuracyFolder(options.output)
        self._folder.begin(self._plan)
        for row in self._rows:  # refuses what rows of other settings left
            self._folder.speed(row)
            for seed in range(self._seeds):
                self._folder.run(row, seed)
        self._done, self._all = 0, 0

    def run(self) -> None:
        """Do what is not done."""
        runs = [(row, seed) for seed in range(self._seeds) for row in self._rows]
        missing = [(row, seed) for row, seed in runs if self._folder.lacking(row, seed)]
        print(f"runs: {len(runs)}, done: {len(runs) - len(missing)}", flush=True)
        self._done, self._all = len(runs) - len(missing), len(runs)
        if missing:
            self._start([self._process("rooms")], 1, self._note_failure)
            if not self.failed:
                self._measure([row for row in self._rows if self._folder.speed(row) is None])
                self._train(missing)
        if self._write():
            print(f"{self._folder.path / 'accuracy'}.json, .md, .png", flush=True)

    def _measure(self, rows: Sequence[Row]) -> None:
        """Epochs of rows, each alone on the machine."""
        processes = {self._process("speed", row): row for row in rows}

        def finished(process: Process, status: int, seconds: float) -> None:
            self._note_failure(process, status, seconds)
            speed = self._folder.speed(processes[process])
            if speed is not None:
                row = processes[process]
                told = f"{speed['epoch_seconds']:.2f} s, {self._folder.epochs(row)} epochs"
                busy = sum(speed["wall"]) > _BUSY * sum(speed["measured"])
                warning = " (less by a machine that has nothing else to do)" if busy else ""
                print(f"an epoch of {row.name}: {told}{warning}", flush=True)

        self._start(list(processes), 1, finished)

    def _train(self, runs: Sequence[tuple[Row, int]]) -> None:
        known = [(row, seed) for row, seed in runs if self._folder.speed(row) is not None]
        processes = {self._process("run", row, seed): (row, seed) for row, seed in known}
        start, before = time.perf_counter(), self._done

        def finished(process: Process, status: int, seconds: float) -> None:
            self._note_failure(process, status, seconds)
            if status == 0:
                self._done += 1
                each = (time.perf_counter() - start) / (self._done - before)
                left = each * (len(known) + before - self._done)
                self._say(*processes[process], seconds, left)
                self._write()

        self._start(list(processes), self._jobs, finished)

    def _say(self, row: Row, seed: int, seconds: float, left_s: float) -> None:
        found = results_of(self._folder.run(row, seed) or {}, PLAIN)
        scores = ", ".join(
            f"{title} {100 * found[name]['miou']:.1f}" for name, title in ORIENTATIONS.items()
        )
        print(
            f"[{self._done}/{self._all}] {row.name}, seed {seed}: {scores} "
            f"({seconds:.0f} s, {left_s / 60:.0f} min left)",
            flush=True,
        )

    def _process(self, what: str, row: Row | None = None, seed: int | None = None) -> Process:
        path = self._folder.path
        of_run = [] if row is None else [row.name]
        of_run += [] if seed is None else [str(seed)]
        log = path / "logs" / f"{'-'.join([what, *of_run])}.txt"
        arguments = ("-m", "benchmarks.accuracy_run", what, str(path), *of_run)
        return Process(" ".join([what, *of_run]), arguments, log)

    def _start(self, processes: Sequence[Process], at_once: int, finished: Finished) -> None:
        run_processes(processes, at_once, finished, self._environment)

    def _note_failure(self, process: Process, status: int, _: float) -> None:
        if status:
            self.failed.append(process.name)
            last = process.log.read_text(errors="replace").splitlines()[-_LOG_LINES:]
            print(f"{process.name} failed ({process.log}):", *last, sep="\n  ", flush=True)

    def _write(self) -> bool:
        """The table and the picture of what there is; False where there is nothing."""
        from benchmarks.accuracy_chart import accuracy_png  # slow, and not for --help

        lines = found_lines(self._folder, self._rows, self._seeds)
        if lines:
            write_tables(self._folder, lines)
            title = f"{self._plan.seconds:g} s of training, level {self._plan.level}"
            write_bytes(self._folder.path / "accuracy.png", accuracy_png(lines, title))
        return bool(lines)
