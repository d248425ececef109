"""Callbacks, plugins and profilers of the user in runs, and debug runs."""

from __future__ import annotations

import csv
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from lightning.pytorch.callbacks import Callback, RichModelSummary, Timer
from lightning.pytorch.plugins import DoublePrecision

from tangent_train.callbacks.checkpoints import AtomicCheckpointIO, CheckpointContents
from tangent_train.cli import trainer as trainer_module
from tangent_train.cli.stored import stored_run
from tangent_train.cli.trainer import build_trainer
from tangent_train.errors import SettingError
from tests.cli.tiny_runs import SETTINGS, Run
from tests.running import composed_settings
from tests.tasks.shapes import shape_task

_CUT = """
from pathlib import Path
from lightning.pytorch.callbacks import Callback

class Cut(Callback):
    '''Interrupts a run in an epoch, once.'''
    def __init__(self, epoch, file):
        self.epoch, self.file = epoch, Path(file)

    def on_train_epoch_start(self, trainer, pl_module):
        if trainer.current_epoch == self.epoch and not self.file.exists():
            self.file.touch()
            raise RuntimeError("interrupted")
"""


def _epochs(folder: Path) -> list[dict[str, str]]:
    """Rows of all validations of a run, without what differs in a resumed one."""
    rows = []
    for path in sorted((folder / "csv").glob("*/metrics.csv")):
        lines = path.read_text().splitlines()
        rows += [row for row in csv.DictReader(lines) if row.get("val/miou")]
    return [
        {n: v for n, v in row.items() if n.startswith(("epoch", "val", "step"))} for row in rows
    ]


def _last(folder: Path) -> Any:
    return torch.load(folder / "checkpoints" / "last.ckpt", weights_only=True)


def test_an_early_stop_is_at_the_same_epoch_after_a_resume(
    rooms: str,
    tmp_path: Path,
    run: Run,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    (tmp_path / "cutting.py").write_text(_CUT)
    monkeypatch.syspath_prepend(str(tmp_path))
    # The best epoch is the first one: nothing is learned.
    settings = [*SETTINGS, rooms, "trainer.max_epochs=9", "scheduler=constant", "optimizer.lr=1e-9"]
    settings += ["logger=csv", "callbacks=early_stopping", "callbacks.early_stopping.patience=3"]
    settings += ["callbacks.early_stopping.min_delta=0.01"]
    cut = f"+callbacks.cut={{_target_: cutting.Cut, epoch: 2, file: {tmp_path}/cut_before}}"
    run("train", *settings, "hydra.run.dir=whole")
    assert [row["epoch"] for row in _epochs(Path("whole"))] == ["0", "1", "2", "3"]
    with pytest.raises(RuntimeError, match="interrupted"):
        run("train", *settings, cut, "hydra.run.dir=cut")
    assert len(_epochs(Path("cut"))) == 2
    assert "/cut trainer.accelerator=cpu\n" in capsys.readouterr().err
    with monkeypatch.context() as machine:  # where none of the settings is remembered
        machine.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
        with pytest.raises(SystemExit, match=r"callbacks\.cut\._target_: found None"):
            run("train", "resume=cut", rooms, *settings[-2:])
    shutil.copytree("cut", "of_others")  # a file does not choose a logger
    for folder, is_kept in (("cut", True), ("of_others", False)):
        stored = stored_run("train", [f"resume={folder}"])
        assert stored is not None
        assert ("logger=csv" in stored.arguments) == is_kept
    for _ in range(2):  # the second time, its training is over
        run("train", "resume=cut")
        assert _epochs(Path("cut")) == _epochs(Path("whole"))
        assert _last(Path("cut"))["global_step"] == _last(Path("whole"))["global_step"]
    assert _last(Path("cut"))["stopped"] is True


class Named(Callback):
    """A callback with settings that are called as those of loggers."""

    def __init__(self, name: str | None, save_dir: str | None) -> None:
        self.given = name, save_dir


@pytest.mark.parametrize(("seconds", "stopped"), [(3600, True), (0, False)])
def test_an_early_stop_before_its_time_is_over_is_kept(seconds: int, stopped: bool) -> None:
    timer = Timer({"seconds": seconds})
    trainer: Any = SimpleNamespace(callbacks=[timer], should_stop=True, world_size=1)
    checkpoint: dict[str, Any] = {}
    CheckpointContents({}).on_save_checkpoint(trainer, shape_task(), checkpoint)
    assert checkpoint["stopped"] is stopped


def test_loggers_and_plugins_of_the_user_are_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    plugin = "{_target_: lightning.pytorch.plugins.DoublePrecision}"
    settings = composed_settings(
        "train",
        "trainer.precision=null",
        f"+trainer.plugins=[{plugin}]",
        "logger=none",
        "+logger.mine={_target_: lightning.pytorch.loggers.CSVLogger, save_dir: here, name: x}",
        "+logger.none=null",
        "callbacks=model_summary",
        f"+callbacks.mine={{_target_: {__name__}.Named, name: null, save_dir: null}}",
    )
    trainer: Any = build_trainer(settings, tmp_path, shape_task(), {"config": {}})
    assert isinstance(trainer.precision_plugin, DoublePrecision)
    assert isinstance(trainer.strategy.checkpoint_io, AtomicCheckpointIO), "that of every run too"
    assert [logger.save_dir for logger in trainer.loggers] == ["here"]
    assert any(isinstance(one, RichModelSummary) for one in trainer.callbacks)
    (callback,) = (one for one in trainer.callbacks if isinstance(one, Named))
    assert callback.given == (None, None), "a callback's own nulls stay"


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("+trainer.logger=false", r"trainer\.logger: found a value; .*logger=null"),
        ("+trainer.callbacks=[x]", r"trainer\.callbacks: found a value; .*\+callbacks\.mine="),
        ("+trainer.default_root_dir=x", r"found a value; .*hydra\.run\.dir="),
        ("+trainer.use_distributed_sampler=true", "found a value; .*every image once"),
        ("+callbacks.mine=early", r"callbacks\.mine: found early; expected .*_target_"),
        ("+logger.mine={_target_: absent.Logger}", r"logger\.mine.*absent"),
        (
            "+logger.mine={_target_: lightning.pytorch.loggers.CometLogger}",
            r"^logger\.mine: ((?!tangent-train\[).)*$",
        ),
        ("+trainer.plugins=[a]", r"^trainer\.plugins\.0: found a"),
    ],
)
def test_other_places_for_them_are_refused(override: str, message: str, tmp_path: Path) -> None:
    settings = composed_settings("train", override)
    with pytest.raises(SettingError, match=message):
        build_trainer(settings, tmp_path, shape_task(), {"config": {}})


def test_runs_are_named_by_their_folders_and_grouped_by_sweep_and_transfer() -> None:
    for folder, name, group in (
        ("/x/runs/demo/2026-01-02", "demo/2026-01-02", "demo"),
        ("/x/runs/demo/2026-01-02/3", "demo/2026-01-02/3", "demo/2026-01-02"),
        ("runs/transfer/mine/fold_1/seed_0/P", "transfer/mine/fold_1/seed_0/P", "transfer/mine"),
        ("/somewhere/out/b", "out/b", "out"),
    ):
        names = trainer_module._logger_names(Path(folder))
        assert names == {"name": name, "run_name": name, "group": group}
