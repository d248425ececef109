"""Runs of several processes: the steps and figures of one, also when they are cut short."""

from __future__ import annotations

import csv
import re
import shutil
import signal
from pathlib import Path

import numpy as np
import pytest
import torch

from tangent_train.cli.processes import command_line
from tangent_train.results.evaluation import load_result
from tests.cli.tiny_runs import SETTINGS, Run, results
from tests.datamodules.data_files import write_png
from tests.running import run_python
from tests.slow.cli.test_signals import CUT_SHORT

TRAIN, EVALUATE = (command_line(name, (), Path())[0] for name in ("train", "evaluate"))


def _train(folder: Path, *arguments: str, status: int = 0, program: str = TRAIN) -> str:
    done = run_python(folder, program, *arguments)
    assert done.returncode == status, done.stderr
    return done.stderr


def _names_in_report(run: Path) -> list[str]:
    return re.findall(r"area_\w+/\w+", (run / "report.html").read_text())


def _scalars(run: Path) -> dict[str, list[float]]:
    """Logged values by name, but for the epoch."""
    (path,) = run.glob("csv/*/metrics.csv")
    rows = list(csv.DictReader(path.read_text().splitlines()))
    names = rows[0].keys() - {"epoch"}
    return {name: [float(row[name]) for row in rows if row[name]] for name in names}


def test_two_processes_make_the_steps_and_figures_of_one(
    rooms: str, tmp_path: Path, run: Run, plain: tuple[str, ...]
) -> None:
    settings = [text for text in SETTINGS if not text.startswith("network.")]
    common = [*plain, *settings, rooms]
    common += ["trainer.max_steps=3", "data.val_fraction=0.4", "panels=2"]
    common += ["logger=many", "trainer.log_every_n_steps=1"]
    # Not of Adam, whose steps do not depend on the size of the gradient.
    common += ["optimizer=adam", "optimizer._target_=torch.optim.SGD", "optimizer.lr=0.1"]
    one = ["data.batch_size=2", "hydra.run.dir=one"]
    run("train", *common, *one)
    devices = ["trainer.accelerator=cpu", "trainer.devices=2"]
    two = [*common, "trainer=ddp", *devices, "trainer.max_steps=3"]
    two += ["data.batch_size=1", "task.view_batch_size=2"]
    _train(tmp_path, *two, "hydra.run.dir=two")
    assert {"one", "own", "two"} >= {p.name for p in tmp_path.iterdir()}
    logged = [_scalars(tmp_path / name) for name in ("one", "two")]
    assert logged[1].keys() == logged[0].keys()
    for scalars in logged:
        assert (len(scalars["train/loss"]), len(scalars["val/miou"])) == (3, 1), "logged once"
    # The third step is the rest of the first epoch, or begins the second one.
    assert logged[1]["train/loss"][:2] == pytest.approx(logged[0]["train/loss"][:2], abs=1e-4)
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
    _train(tmp_path, *two, "hydra.run.dir=cut", status=128 + signal.SIGHUP, program="cut_short.py")
    _train(tmp_path, f"resume={tmp_path / 'cut'}")
    assert results(tmp_path / "cut") == results(tmp_path / "two")
    checkpoint = f"checkpoint={tmp_path / 'one' / 'checkpoints' / 'last.ckpt'}"
    odd = "data.fold=3"  # five test panoramas: 3 and 2
    data = [text for text in SETTINGS if text.startswith("data.")] + [rooms, "data=synthrooms"]
    run("evaluate", checkpoint, *data, odd, "hydra.run.dir=again")
    ddp = ["trainer=ddp", *devices, "hydra.run.dir=evaluated"]
    assert run_python(tmp_path, EVALUATE, checkpoint, *data, odd, *ddp).returncode == 0
    figures = [results(tmp_path / folder) for folder in ("again", "evaluated")]
    assert figures[0]["images"] == figures[1]["images"] == 5
    assert figures[0]["confusion"] == figures[1]["confusion"]
    assert figures[0]["scores"]["miou_solid_angle"] == pytest.approx(
        figures[1]["scores"]["miou_solid_angle"]
    )


def test_depth_of_two_processes_is_that_of_one(
    rooms: str, tmp_path: Path, run: Run, plain: tuple[str, ...]
) -> None:
    """Three and two test panoramas; one of them, and one for training, without known distances."""
    root = shutil.copytree(rooms.split("'")[1], tmp_path / "rooms")
    for area in ("area_3", "area_5a"):
        depth = max(root.glob(f"{area}/pano/depth/*.png"))
        write_png(depth, np.full((32, 64), 65535, np.uint16))
    common = [*plain, *(text for text in SETTINGS if not text.startswith("network."))]
    common += ["task=depth", "network.in_channels=3", "network.out_channels=1", "data.inputs=[rgb]"]
    common += [f"data.root={root}", "data.fold=3"]
    common += ["trainer.max_steps=2", "trainer.log_every_n_steps=1", "logger=csv"]
    common += ["optimizer=adam", "optimizer._target_=torch.optim.SGD", "optimizer.lr=0.1"]
    run("train", *common, "hydra.run.dir=one")
    two = ["trainer=ddp", "trainer.accelerator=cpu", "trainer.devices=2", "trainer.max_steps=2"]
    _train(tmp_path, *common, *two, "data.batch_size=1", "hydra.run.dir=two")
    logged = [_scalars(tmp_path / name) for name in ("one", "two")]
    assert logged[1].keys() == logged[0].keys()
    for name in ("train/loss", "val/loss", "val/absrel"):
        assert logged[1][name] == pytest.approx(logged[0][name], rel=1e-5), name
    first, second = (load_result(tmp_path / name) for name in ("one", "two"))
    assert second.images == first.images == 5
    assert second.protocol == first.protocol
    assert second.protocol["views_aligned"] == "scale"
    scores = [{n: v for n, v in r.scores.items() if v is not None} for r in (first, second)]
    assert {"absrel", "seam_step"} < scores[0].keys()
    assert scores[1] == pytest.approx(scores[0], rel=1e-4)
    for name, interval in first.intervals.items():
        assert second.intervals[name] == pytest.approx(interval, rel=1e-4)
    for bands in zip(first.latitude_bands, second.latitude_bands, strict=True):
        assert bands[1]["absrel"] == pytest.approx(bands[0]["absrel"], rel=1e-4)
