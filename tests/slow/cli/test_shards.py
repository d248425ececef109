"""Shards of predictions in processes of their own, at once, one of them killed."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import time
from pathlib import Path

import numpy as np
import pytest

from tangent_train.cli.processes import command_line
from tangent_train.io.pixel_files import write_pixels
from tests.cli.test_shards import results
from tests.cli.tiny_runs import run_command
from tests.inference.trained import sphere, write_checkpoint

ROOT = Path(__file__).parents[3]
COUNT = 30


@pytest.fixture
def settings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Settings for predictions of thirty panoramas, which are in ``whole``."""
    monkeypatch.chdir(tmp_path)
    for number in range(COUNT):
        write_pixels(tmp_path / "in" / f"{number:02}.png", np.roll(sphere(128), number, 1))
    checkpoint = write_checkpoint(tmp_path / "model.ckpt")
    settings = [f"checkpoint={checkpoint}", "input=in", "report=5"]
    run_command(monkeypatch, "predict", *settings, "output=whole")
    return settings


def _started(*arguments: str) -> subprocess.Popen[bytes]:
    environment = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    line = command_line("predict", arguments, Path())
    return subprocess.Popen(line, env=environment)


def _finished(shard: str) -> list[str]:
    file = Path("out", f"finished-{shard}.jsonl")
    return [json.loads(line)["item"] for line in file.read_text().splitlines()]


def test_one_of_them_is_killed_and_continued(settings: list[str]) -> None:
    settings = [*settings, "output=out"]
    killed, other = (_started(*settings, f"shard={n}/3") for n in (1, 2))
    while not Path("out/finished-1-of-3.jsonl").exists():
        assert killed.poll() is None
        time.sleep(0.01)
    killed.send_signal(signal.SIGKILL)
    assert killed.wait() == -signal.SIGKILL
    before = _finished("1-of-3")
    assert 0 < len(before) < COUNT // 3
    kept = Path("out", "labels", f"{before[0]}.png")
    time_ns = kept.stat().st_mtime_ns
    again = [_started(*settings, f"shard={n}/3") for n in (1, 3)]
    assert [process.wait(300) for process in (other, *again)] == [0, 0, 0]
    assert kept.stat().st_mtime_ns == time_ns
    assert [sorted(_finished(f"{n}-of-3")) for n in (1, 2, 3)] == [
        [f"{number:02}" for number in range(first, COUNT, 3)] for first in range(3)
    ]
    for path in Path("out").rglob(".partial*"):  # of the killed one
        path.unlink()
    assert results("out") == results("whole")
