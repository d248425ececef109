"""Runs that are killed at random moments and resumed, compared with one that nobody disturbed.

``python -m tests.slow.faults.kills --moments 20`` prints what was found; see ``--help``. A run
trains with dropout, validates, writes checkpoints all the time, evaluates and writes its results;
SIGKILL comes at a moment drawn between its first checkpoint and its end, and comes again while
every other run is resumed.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import random
import shutil
import signal
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import torch

from tests.dropping import TRUST, write_dropout

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from multiprocessing.process import BaseProcess

__all__ = ["Outcome", "campaign", "killed_while_writing"]

_PATIENCE_S = 300.0


@dataclass(frozen=True)
class Outcome:
    """What became of one run.

    Attributes:
        killed_after_s: Seconds after its first checkpoint, one number per kill.
        steps: That the checkpoint had then, likewise.
        evaluated: Whether results were there then, likewise.
        left: Temporary files that the kills left.
        broken: Files that were half, with what is wrong with them.
        different: What is not as in the undisturbed run.
    """

    killed_after_s: tuple[float, ...]
    steps: tuple[int, ...]
    evaluated: tuple[bool, ...]
    left: int
    broken: tuple[str, ...]
    different: tuple[str, ...]


def campaign(root: Path, folder: Path, moments: int, seed: int) -> Iterator[Outcome]:
    """Kill runs and resume them.

    Args:
        root: A data set in the format of Stanford2D3DS.
        folder: Where the runs are written.
        moments: How many runs.
        seed: Of the moments.

    Yields:
        What became of each.
    """
    write_dropout(folder)
    undisturbed = folder / "undisturbed"
    process = _started(undisturbed, folder, _settings(root, folder))
    _await_checkpoint(process, undisturbed)
    begun = time.monotonic()
    _await_end(process, undisturbed)
    duration_s = time.monotonic() - begun
    draw = random.Random(seed)
    for number in range(moments):
        run = folder / f"run_{number}"
        kills = 1 + number % 2
        yield _disturbed(run, undisturbed, root, kills, duration_s, draw)


def killed_while_writing(root: Path, folder: Path) -> Outcome:
    """Kill a run in the middle of a checkpoint, and resume it.

    Args:
        root: As in `campaign`.
        folder: As in `campaign`, which has been run there.
    """
    run = folder / "while_writing"
    process = _started(run, folder, _settings(root, folder), _die_in_a_checkpoint)
    process.join(_PATIENCE_S)
    if process.exitcode != -signal.SIGKILL:
        raise RuntimeError(f"status {process.exitcode} of a run that was to be killed")
    steps = _loaded(run / "checkpoints" / "last.ckpt")["global_step"]
    left = len(list(run.rglob(".partial-*")))
    broken = [f"{path.name}: {error}" for path, error in _broken(run)]
    _await_end(_started(run, folder, _again(root, run)), run)
    broken += [f"{path.name}: {error}" for path, error in _broken(run)]
    different = tuple(_different(run, folder / "undisturbed"))
    return Outcome((), (steps,), (False,), left, tuple(broken), different)


def _die_in_a_checkpoint() -> None:
    """Let this process be killed when half of its twelfth checkpoint is written."""
    save, saved = torch.save, []

    def half(content: Any, path: Path) -> None:
        saved.append(path)
        save(content, path)
        if len(saved) == 12:
            os.truncate(path, path.stat().st_size // 2)
            os.kill(os.getpid(), signal.SIGKILL)

    torch.save = half  # type: ignore[assignment]


def _settings(root: Path, folder: Path) -> list[str]:
    return [
        "--config-dir", str(folder), "network=dropout", "data=stanford2d3ds", f"data.root={root}",
        "level=4", "representation.crop_multiple=null", "data.panoramas_per_step=1",
        "data.num_workers=0", "data.validation_fraction=0.2", "trainer.max_epochs=4",
        "trainer.accelerator=cpu", "trainer.log_every_n_steps=1", "checkpoint_every_n_steps=1",
        "panels=2",
    ]  # fmt: skip


def _again(root: Path, run: Path) -> list[str]:
    return [f"resume={run}", f"data.root={root}", TRUST]


def _disturbed(
    run: Path,
    undisturbed: Path,
    root: Path,
    kills: int,
    duration_s: float,
    draw: random.Random,
) -> Outcome:
    after: list[float] = []
    steps: list[int] = []
    evaluated: list[bool] = []
    broken: list[str] = []
    arguments = _settings(root, run.parent)
    while len(after) < kills:
        process = _started(run, run.parent, arguments)
        _await_checkpoint(process, run)
        moment_s = draw.uniform(0, 1.3 * duration_s)  # the machine may be slower now
        process.join(moment_s)
        process.kill()
        process.join()
        if process.exitcode == 0:  # it had ended: that was no kill
            if not after:
                shutil.rmtree(run)
            continue
        after.append(moment_s)
        steps.append(_loaded(run / "checkpoints" / "last.ckpt")["global_step"])
        evaluated.append((run / "results.json").exists())
        broken += [f"{path.name}: {error}" for path, error in _broken(run)]
        arguments = _again(root, run)
    left = len(list(run.rglob(".partial-*")))
    _await_end(_started(run, run.parent, arguments), run)
    broken += [f"{path.name}: {error}" for path, error in _broken(run)]
    different = tuple(_different(run, undisturbed))
    return Outcome(tuple(after), tuple(steps), tuple(evaluated), left, tuple(broken), different)


def _started(
    run: Path, folder: Path, arguments: list[str], before: Callable[[], None] | None = None
) -> BaseProcess:
    """Start a run in a process that has imported all it needs."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["tangent_train.cli.train", "tensorboard", "hydra.main"])
    if not any(argument.startswith("resume=") for argument in arguments):
        arguments = [*arguments, f"hydra.run.dir={run}"]
    log = run.with_suffix(".log")
    process = context.Process(target=_train, args=(arguments, folder, log, before))
    process.start()
    return process


def _train(
    arguments: list[str], folder: Path, log: Path, before: Callable[[], None] | None
) -> None:
    os.chdir(folder)
    sys.path.insert(0, str(folder))  # its network
    with log.open("a") as file:
        for stream in (1, 2):
            os.dup2(file.fileno(), stream)
    if before is not None:
        before()
    sys.argv = ["tangent-train", *arguments]
    from tangent_train.cli.main import train

    train()


def _await_checkpoint(process: BaseProcess, run: Path) -> None:
    path, end = run / "checkpoints" / "last.ckpt", time.monotonic() + _PATIENCE_S
    while not path.exists():
        if not process.is_alive() or time.monotonic() > end:
            raise RuntimeError(f"no {path}:\n{run.with_suffix('.log').read_text()[-2000:]}")
        time.sleep(0.005)


def _await_end(process: BaseProcess, run: Path) -> None:
    process.join(_PATIENCE_S)
    if process.exitcode != 0:
        process.kill()
        log = run.with_suffix(".log").read_text()[-2000:]
        raise RuntimeError(f"{run}: status {process.exitcode}:\n{log}")


def _loaded(path: Path) -> dict[str, Any]:
    content: dict[str, Any] = torch.load(path, weights_only=True)
    return content


def _read(path: Path) -> None:
    """Fail if a file is not whole."""
    if path.suffix == ".ckpt":
        _loaded(path)
    elif path.suffix == ".json":
        json.loads(path.read_text(encoding="utf-8"))
    elif path.suffix == ".png":
        if cv2.imread(str(path)) is None:
            raise ValueError("cannot be decoded")
    elif path.suffix == ".html":
        if not path.read_text(encoding="utf-8").rstrip().endswith("</html>"):
            raise ValueError("ends in the middle")
    elif path.suffix in (".csv", ".md", ".yaml") and not path.read_text().endswith("\n"):
        raise ValueError("ends in the middle")


def _broken(run: Path) -> Iterator[tuple[Path, Exception]]:
    for path in run.rglob("*"):
        # Hydra writes its own folder as it likes; no training reads it.
        passed_over = path.name.startswith(".partial-") or path.parent.name == ".hydra"
        if path.is_file() and not passed_over:
            try:
                _read(path)
            except Exception as error:
                yield path, error


def _different(run: Path, undisturbed: Path) -> Iterator[str]:
    for name, parts in (
        ("last.ckpt", ("state_dict", "optimizer_states", "lr_schedulers", "global_step")),
        ("best.ckpt", ("state_dict", "global_step")),
    ):
        found, expected = (_loaded(r / "checkpoints" / name) for r in (run, undisturbed))
        for part in parts:
            try:
                torch.testing.assert_close(found[part], expected[part], rtol=0, atol=0)
            except AssertionError as error:
                yield f"{name}, {part}: {error}"
    for name in ("results.json", "results.csv", "results.md"):
        if (run / name).read_bytes() != (undisturbed / name).read_bytes():
            yield name
    if {p.name for p in (run / "panels").iterdir()} != {
        p.name for p in (undisturbed / "panels").iterdir()
    }:
        yield "panels"


def _main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.slow.faults.kills", description=__doc__)
    parser.add_argument("--moments", type=int, default=20, help="runs (20)")
    parser.add_argument("--seed", type=int, default=0, help="of the moments (0)")
    options = parser.parse_args()
    from tests.conftest import fabricate

    kills = failures = 0
    with tempfile.TemporaryDirectory() as name:
        root = fabricate(Path(name) / "data")
        runs = campaign(root, Path(name) / "runs", options.moments, options.seed)
        for number, outcome in enumerate(runs):
            kills += len(outcome.steps)
            failures += bool(outcome.broken or outcome.different)
            print(number, outcome, flush=True)  # noqa: T201 - for people
    print(f"{options.moments} runs, {kills} kills, {failures} not as undisturbed")  # noqa: T201
    return failures


if __name__ == "__main__":
    sys.exit(_main())
