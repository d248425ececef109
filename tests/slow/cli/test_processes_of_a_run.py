"""Runs of several processes: the steps and figures of one, also when they are cut short."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import torch

from tests.cli.test_commands import CUT_SHORT
from tests.cli.tiny_runs import SETTINGS, Run, results
from tests.running import run_python


def _train(folder: Path, *arguments: str, status: int = 0, program: str = "-m") -> str:
    command = ["-m", "tangent_train.cli.main", "train"] if program == "-m" else [program]
    done = run_python(folder, *command, *arguments)
    assert done.returncode == status, done.stderr
    return done.stderr


def _names_in_report(run: Path) -> list[str]:
    return re.findall(r"area_\w+/\w+", (run / "report.html").read_text())


def test_two_processes_make_the_steps_and_figures_of_one(
    rooms: str, tmp_path: Path, run: Run, plain: tuple[str, ...]
) -> None:
    settings = [text for text in SETTINGS if not text.startswith("network.")]
    common = [*plain, *settings, rooms]
    common += ["trainer.max_steps=3", "optimizer=adam", "data.validation_fraction=0.4", "panels=2"]
    one = ["data.panoramas_per_step=2", "hydra.run.dir=one"]
    run("train", *common, *one)
    devices = ["trainer.accelerator=cpu", "trainer.devices=2"]
    two = [*common, "trainer=ddp", *devices, "trainer.max_steps=3"]
    two += ["data.panoramas_per_step=1", "task.images_per_chunk=2"]
    _train(tmp_path, *two, "hydra.run.dir=two")
    assert {path.name for path in tmp_path.iterdir()} == {"one", "two", "own"}, "one folder each"
    first, second = (
        torch.load(tmp_path / n / "checkpoints" / "last.ckpt", weights_only=True)
        for n in ("one", "two")
    )
    assert first["global_step"] == second["global_step"] == 3
    torch.testing.assert_close(second["state_dict"], first["state_dict"], rtol=0, atol=1e-6)
    names = [_names_in_report(tmp_path / run) for run in ("one", "two")]
    assert names[0] == names[1], "panels of all processes, in order"
    assert len(set(names[0])) == 2

    (tmp_path / "cut_short.py").write_text(CUT_SHORT)
    _train(tmp_path, *two, "hydra.run.dir=cut", status=143, program="cut_short.py")
    resumed = (f"resume={tmp_path / 'cut'}", rooms, *devices, "trainer.strategy=ddp")
    _train(tmp_path, *resumed)
    assert results(tmp_path / "cut") == results(tmp_path / "two")
    checkpoint = f"checkpoint={tmp_path / 'one' / 'checkpoints' / 'last.ckpt'}"
    run("evaluate", checkpoint, rooms, "hydra.run.dir=again")
    ddp = ["trainer=ddp", *devices, "hydra.run.dir=evaluated"]
    evaluate = ("-m", "tangent_train.cli.main", "evaluate", checkpoint, rooms, *ddp)
    assert run_python(tmp_path, *evaluate).returncode == 0
    figures = [results(tmp_path / folder) for folder in ("again", "evaluated")]
    assert figures[0]["confusion"] == figures[1]["confusion"]
    assert figures[0]["miou_solid_angle"] == pytest.approx(figures[1]["miou_solid_angle"])
