"""Runs killed at random moments and resumed, compared with an undisturbed run.

A run trains with dropout, validates, writes checkpoints continually, evaluates and writes its
results; SIGKILL comes at a moment drawn between its first checkpoint and its end, and comes again
while the second run is resumed.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import random
import signal
import sys
import time
from collections.abc import Callable
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import pytest
import torch

from tests.dropping import TRUST, write_dropout

_PATIENCE_S = 300.0
_RUNS = 2
_SETTINGS = (
    "network=dropout",
    "data=stanford2d3ds",
    "level=4",
    "representation.crop_multiple=null",
    "data.batch_size=1",
    "data.num_workers=0",
    "data.val_fraction=0.2",
    "trainer.max_epochs=4",
    "trainer.accelerator=cpu",
    "trainer.log_every_n_steps=1",
    "checkpoint_every_n_steps=1",
    "panels=2",
)


def _start(run: Path, root: Path, before: Callable[[], None] | None = None) -> BaseProcess:
    """Start or resume a run, in a process forked from one that has imported all it needs."""
    context = multiprocessing.get_context("forkserver")
    arguments = ["--config-dir", str(run.parent), *_SETTINGS, f"hydra.run.dir={run}"]
    if _last(run).exists():
        arguments = [f"resume={run}", TRUST]
    arguments.append(f"data.root={root}")
    process = context.Process(target=_train, args=(arguments, run, before))
    process.start()
    return process


def _train(arguments: list[str], run: Path, before: Callable[[], None] | None) -> None:
    os.chdir(run.parent)
    sys.path.insert(0, str(run.parent))  # its network
    with run.with_suffix(".log").open("a") as file:
        for stream in (1, 2):
            os.dup2(file.fileno(), stream)
    if before is not None:
        before()
    sys.argv = ["tangent-train", *arguments]
    from tangent_train.cli.main import train

    train()


def _last(run: Path) -> Path:
    return run / "checkpoints" / "last.ckpt"


def _log(run: Path) -> str:
    return run.with_suffix(".log").read_text()[-2000:]


def _await_checkpoint(process: BaseProcess, run: Path) -> None:
    end = time.monotonic() + _PATIENCE_S
    while not _last(run).exists():
        assert process.is_alive(), _log(run)
        assert time.monotonic() < end
        time.sleep(0.005)


def _await_end(process: BaseProcess, run: Path) -> None:
    process.join(_PATIENCE_S)
    if process.exitcode != 0:
        process.kill()
        pytest.fail(f"status {process.exitcode}:\n{_log(run)}")


def _killed(run: Path, root: Path, longest_s: float, draw: random.Random) -> bool:
    """Start or resume a run and kill it; False if it had ended by then."""
    process = _start(run, root)
    _await_checkpoint(process, run)
    process.join(draw.uniform(0, longest_s))
    process.kill()
    process.join()
    return process.exitcode != 0


def _loaded(path: Path) -> dict[str, Any]:
    content: dict[str, Any] = torch.load(path, weights_only=True)
    return content


def _assert_whole(run: Path) -> None:
    """Every checkpoint and every JSON file of a run can be read but for temporary ones."""
    for path in run.rglob("[!.]*.*"):
        if path.suffix == ".ckpt":
            _loaded(path)
        elif path.suffix == ".json":
            json.loads(path.read_text(encoding="utf-8"))


def _assert_same(run: Path, undisturbed: Path) -> None:
    for name, parts in (
        ("last.ckpt", ("state_dict", "optimizer_states", "lr_schedulers", "global_step")),
        ("best.ckpt", ("state_dict", "global_step")),
    ):
        found, expected = (_loaded(r / "checkpoints" / name) for r in (run, undisturbed))
        for part in parts:
            torch.testing.assert_close(found[part], expected[part], rtol=0, atol=0)
    for name in ("results.json", "results.csv", "results.md"):
        assert (run / name).read_bytes() == (undisturbed / name).read_bytes()
    panels, expected_panels = (  # a killed run may leave files with temporary names
        {path.name for path in (r / "panels").glob("[!.]*")} for r in (run, undisturbed)
    )
    assert panels == expected_panels


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


def test_killed_runs_end_as_if_nothing_had_happened(stanford_root: Path, tmp_path: Path) -> None:
    folder = tmp_path / "runs"
    write_dropout(folder)
    undisturbed = folder / "undisturbed"
    process = _start(undisturbed, stanford_root)
    _await_checkpoint(process, undisturbed)
    begun = time.monotonic()
    _await_end(process, undisturbed)
    longest_s = 1.3 * (time.monotonic() - begun)  # the machine may be slower later

    draw = random.Random(1)
    kills = 0
    for number in range(_RUNS):
        run = folder / f"run_{number}"
        for _ in range(1 + number % 2):
            kills += _killed(run, stanford_root, longest_s, draw)
            _assert_whole(run)
        _await_end(_start(run, stanford_root), run)
        _assert_whole(run)
        _assert_same(run, undisturbed)
    assert kills >= _RUNS / 2

    run = folder / "while_writing"
    process = _start(run, stanford_root, _die_in_a_checkpoint)
    process.join(_PATIENCE_S)
    assert process.exitcode == -signal.SIGKILL, _log(run)
    assert len(list(run.rglob(".partial-*"))) == 1, "a partial checkpoint, which is not read"
    _assert_whole(run)
    _await_end(_start(run, stanford_root), run)
    _assert_whole(run)
    _assert_same(run, undisturbed)
