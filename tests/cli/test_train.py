"""``tangent-train`` on a few tiny synthetic rooms: train, interrupt, resume, fine-tune."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import cv2
import pytest
import torch

from tangent_train.checkpoints.loaded import load_network
from tangent_train.tasks import PixelTask
from tests.cli.tiny_runs import SETTINGS, Run, results
from tests.running import Capture, Patch

OWN_EXPERIMENT = """
# @package _global_
defaults:
  - rooms/demo
callbacks:
  mine:
    _target_: lightning.pytorch.callbacks.EarlyStopping
    monitor: null
    mode: null
    patience: 3
    min_delta: 0.01
"""


def _last(folder: Path) -> Any:
    return torch.load(folder / "checkpoints" / "last.ckpt", weights_only=True)


def test_a_refused_run_names_the_setting_and_leaves_no_folder(run: Run, rooms: str) -> None:
    """The largest rate of the schedule is that of the optimizer."""
    wrong = ("optimizer.lr=abc", "scheduler=one_cycle")
    with pytest.raises(SystemExit, match=r"optimizer\.lr: found abc"):
        run("train", *SETTINGS, rooms, *wrong)
    assert [path for path in Path("runs").rglob("*") if path.is_file()] == []
    with pytest.raises(SystemExit, match="levl"):
        run("train", "data=synthrooms", "+levl=5", "hydra.run.dir=mine")
    assert Path("mine", ".hydra").is_dir(), "the folder that was typed"


def test_a_run_leaves_everything_in_its_folder(run_folder: Path) -> None:
    found = results(run_folder)
    assert found["images"] == 2
    assert len(found["classes"]) == 13
    for name in ("results.md", "results.csv", "config.yaml", "validation.json"):
        assert (run_folder / name).is_file(), name
    log = (run_folder / "train.log").read_text()
    assert "mIoU" in log
    assert "\n| wall |" in log, "the table of results"
    assert list((run_folder / "tensorboard").glob("events.*"))
    (panel,) = (run_folder / "panels").glob("*.png")
    picture = cv2.imread(str(panel))
    assert picture is not None
    assert picture.shape[1] == 2 * 512 + 8
    page = (run_folder / "report.html").read_text()
    assert all(f"<h2>{title}</h2>" in page for title in ("Per class", "Confusion"))
    loaded = load_network(run_folder / "checkpoints" / "best.ckpt")
    assert loaded.class_names[:2] == ("unknown", "beam")
    assert loaded.inputs == ("rgb", "depth")


def test_a_checkpoint_within_an_epoch_holds_the_average_with_its_last_step(
    rooms: str, tmp_path: Path, run: Run, monkeypatch: Patch
) -> None:
    weights: list[dict[str, torch.Tensor]] = []
    step = PixelTask.training_step

    def kept(task: PixelTask, *arguments: Any) -> Any:
        weights.append({n: p.detach().double().clone() for n, p in task.named_parameters()})
        if len(weights) == 4:
            raise CutError
        return step(task, *arguments)

    class CutError(Exception):
        pass

    monkeypatch.setattr(PixelTask, "training_step", kept)
    typed = ("ema=0.7", "checkpoint_every_n_steps=1", "data.batch_size=1")
    with pytest.raises(CutError):
        run("train", *SETTINGS, rooms, *typed, "hydra.run.dir=run")
    content = _last(tmp_path / "run")
    assert content["global_step"] == 3
    for name, third in weights[3].items():  # the average begins with the first step
        first, second = weights[1][name], weights[2][name]
        expected = 0.7 * (0.7 * first + 0.3 * second) + 0.3 * third
        torch.testing.assert_close(
            content["state_dict"][name].double(), expected, rtol=0, atol=1e-6
        )
        assert torch.equal(content["current_model_state"][name].double(), third)


def test_without_validation_the_last_epoch_is_tested(rooms: str, tmp_path: Path, run: Run) -> None:
    checkpoints = tmp_path / "run" / "checkpoints"
    typed = ("scheduler=constant", "data.val_fraction=0", "trainer.max_epochs=1")
    run("train", *SETTINGS, rooms, *typed, "hydra.run.dir=run")
    first = (checkpoints / "best.ckpt").read_bytes()
    assert first == (checkpoints / "last.ckpt").read_bytes()
    run("train", "resume=run", "trainer.max_epochs=2", "logger=csv", "callbacks=model_summary")
    assert (tmp_path / "run" / "csv" / "version_0" / "hparams.yaml").is_file()
    assert first != (checkpoints / "best.ckpt").read_bytes()
    assert results(tmp_path / "run")["images"] == 2
    with pytest.raises(SystemExit, match=r"hydra\.run\.dir: found .*run, the folder of another"):
        run("train", *SETTINGS, rooms, *typed, "hydra.run.dir=run")
    config = (tmp_path / "run" / "config.yaml").read_text()
    assert "max_epochs: 2" in config
    assert [name in config for name in ("CSV", "TensorBoard", "model_summary:")] == [
        True,
        False,
        True,
    ]
    with pytest.raises(SystemExit, match=r"network\.widths: found a value; .*start a new run"):
        run("train", "resume=run", "network.widths=[8]")
    with pytest.raises(SystemExit, match=r"network=, when resuming: found a group; "):
        run("train", "resume=run", "network=unet")
    assert (tmp_path / "run" / "config.yaml").read_text() == config


def test_an_incomplete_test_leaves_no_results(
    rooms: str, tmp_path: Path, run: Run, capsys: Capture
) -> None:
    run("train", *SETTINGS, rooms, "trainer.max_epochs=1", "debug=fast", "hydra.run.dir=run")
    assert "1 of 2 test panoramas were evaluated" in capsys.readouterr().out
    assert not list((tmp_path / "run").glob("results.*"))


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["representation.faces_per_panorama=99"], "representation.faces_per_panorama: found 99"),
        (["task=classification"], "task: found a task for image_class"),
        (["+data.rooot=x"], "Did you mean data.root?"),
        (["network._target_=models.Absent"], "Absent"),
        (
            ["+callbacks.x={_target_: lightning.pytorch.callbacks.LearningRateFinder}"],
            r"callbacks\.x: found LearningRateFinder; .*-m optimizer\.lr=",
        ),
        (
            [
                "+callbacks.x={_target_: lightning.pytorch.callbacks.StochasticWeightAveraging,"
                " swa_lrs: 0.1}"
            ],
            r"callbacks\.x: found StochasticWeightAveraging; .*ema=",
        ),
        (["task.backbone_lr_factor=0.5"], r"lr_factor: found 0\.5; .*without init_from="),
    ],
)
def test_impossible_settings_are_refused_before_any_data_is_made(
    overrides: list[str], message: str, tmp_path: Path, run: Run
) -> None:
    with pytest.raises(SystemExit, match=message):
        run("train", "experiment=rooms/demo", "trainer.accelerator=cpu", *overrides)
    assert not (tmp_path / "data").exists()


def test_an_early_stop_is_at_the_same_epoch_after_a_resume(
    rooms: str, run: Run, monkeypatch: Patch
) -> None:
    # The best epoch is the first one: nothing is learned.
    own = Path("configs", "experiment", "own.yaml")  # declares a callback
    own.parent.mkdir(parents=True)
    own.write_text(OWN_EXPERIMENT)
    settings = ["--config-dir=configs", "experiment=own"]
    settings += [text for text in SETTINGS if not text.startswith("experiment=")]
    settings += [rooms, "trainer.max_epochs=9"]
    settings += ["scheduler=constant", "optimizer.lr=1e-9", "logger=csv"]
    run("train", *settings, "hydra.run.dir=whole")
    start = PixelTask.on_train_epoch_start

    def interrupt(task: PixelTask) -> None:
        if task.current_epoch == 2:
            raise RuntimeError("interrupted")
        start(task)

    with monkeypatch.context() as patch:
        patch.setattr(PixelTask, "on_train_epoch_start", interrupt)
        with pytest.raises(RuntimeError, match="interrupted"):
            run("train", *settings, "hydra.run.dir=cut")
    for _ in range(2):  # the second time, its training is over
        run("train", "resume=cut")
        assert _epochs(Path("cut")) == _epochs(Path("whole"))
        assert _last(Path("cut"))["global_step"] == _last(Path("whole"))["global_step"]


def _epochs(folder: Path) -> list[dict[str, str]]:
    """Return the validations of a run, without what differs in a resumed one."""
    rows = []
    for path in sorted((folder / "csv").glob("*/metrics.csv")):
        lines = path.read_text().splitlines()
        rows += [row for row in csv.DictReader(lines) if row.get("val/miou")]
    return [
        {n: v for n, v in row.items() if n.startswith(("epoch", "val", "step"))} for row in rows
    ]
