"""Commands that are started in a folder of somebody else: nothing in it runs or configures them."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from tests.cli.tiny_runs import SETTINGS
from tests.datamodules.data_files import write_png
from tests.results.example_results import example_result, write_run
from tests.slow.security.hostile_folder import make_hostile, run_in_hostile

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="the loader of glibc")

TRAINING = (*SETTINGS, "data.inputs=[rgb]", "trainer.max_epochs=1", "panels=0")


@pytest.mark.parametrize(
    ("command", "arguments", "made"),
    [
        ("render", ("input=../room.png", "figure=../figure.png", "base_level=0"), "figure.png"),
        ("check", (*SETTINGS, "data.inputs=[rgb]", "data.root=../rooms"), "run"),
        ("report", ("../run", "--output", "../report"), "report/report.png"),
        (
            "keypoints",
            ("left=../room.png", "right=../room.png", "base_level=0", "pictures=1", "output=../k"),
            "k/matches/000_room.png_room.png_as_given.png",
        ),
        (
            "train",  # makes rooms in several processes, trains in two, with workers
            (
                *(*TRAINING, "trainer=ddp", "trainer.devices=2", "data.num_workers=1"),
                *("data.val_fraction=0.4", "data.in_memory=false"),
                *("data.root=../rooms", "hydra.run.dir=../trained"),
            ),
            "trained/results.json",
        ),
        (
            "train",  # in processes of submitit, with Optuna
            (
                *("-m", "sweep=optuna", "launcher=local", "hydra.sweeper.n_trials=1", *TRAINING),
                *("hydra.sweeper.n_jobs=1", "data.val_fraction=0.4", "data.root=../rooms"),
                "hydra.sweep.dir=../sweep",
            ),
            "sweep/0/results.json",
        ),
    ],
)
def test_files_of_the_working_directory_configure_no_command(
    command: str, arguments: tuple[str, ...], made: str, tmp_path: Path
) -> None:
    noise = np.random.default_rng(0).integers(0, 256, (64, 128, 3), np.uint8)
    write_png(tmp_path / "room.png", noise)
    write_run(tmp_path / "run", example_result((0.5, 0.5, 0.5)))
    done = run_in_hostile(make_hostile(tmp_path / "hostile"), command, *arguments)
    assert done.returncode == (command == "check"), done.stderr  # its rooms are not made yet
    found = [str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*")]
    assert made in found
