"""A run that a signal ends, in a process of its own."""

from __future__ import annotations

import shlex
import signal
from pathlib import Path
from typing import Any

import torch

from tests.cli.tiny_runs import SETTINGS, Run, results
from tests.running import ROOT, run_python

CUT_SHORT = """
import os, signal
from tangent_train.cli.main import train
from tangent_train.callbacks.checkpoints import LastCheckpoint

original = LastCheckpoint.on_train_batch_end

def cut_short(self, trainer, *rest):
    if trainer.global_step == 2:
        os.kill(os.getpid(), signal.SIGHUP)
    original(self, trainer, *rest)

LastCheckpoint.on_train_batch_end = cut_short
train()
"""


def _last(folder: Path) -> Any:
    return torch.load(folder / "checkpoints" / "last.ckpt", weights_only=True)


def test_a_terminated_run_goes_on_as_if_nothing_had_happened(
    run_folder: Path, rooms: str, tmp_path: Path, run: Run
) -> None:
    (tmp_path / "cut_short.py").write_text(CUT_SHORT)
    cut = run_python(tmp_path, "cut_short.py", *SETTINGS, rooms, "hydra.run.dir=cut")
    assert cut.returncode == 128 + signal.SIGHUP, cut.stderr
    assert "Traceback" not in cut.stderr
    printed = shlex.split(cut.stderr.strip().splitlines()[-1])
    assert printed == [f"PYTHONPATH={ROOT}", "tangent-train", f"resume={tmp_path / 'cut'}"]
    run("train", printed[-1])
    found, expected = _last(tmp_path / "cut"), _last(run_folder)
    for part in ("state_dict", "optimizer_states"):
        torch.testing.assert_close(found[part], expected[part], rtol=0, atol=0)
    assert found["lr_schedulers"] == expected["lr_schedulers"]
    assert results(tmp_path / "cut") == results(run_folder)
