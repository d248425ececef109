"""Full disks: existing files stay, no partial file is left, and the message has a remedy.

A limit on the size of files is real and needs no rights; a small disk is mounted where that is
allowed.
"""

from __future__ import annotations

import re
import resource
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import lightning
import numpy as np
import pytest
import torch
from lightning.pytorch.loggers import TensorBoardLogger

from tangent_train.callbacks.checkpoints import AtomicCheckpointIO
from tangent_train.cli.run import machine_faults
from tangent_train.files import NoRoomError, atomic_path, reserve, write_text
from tests.slow.faults.small_runs import Faulty, run_trainer, small_data, small_task

LIMIT = 1 << 16
LARGE = 100_000


def _text(path: Path) -> None:
    write_text(path, "x" * LARGE)


def _torch(path: Path) -> None:
    AtomicCheckpointIO().save_checkpoint({"weights": torch.zeros(LARGE)}, path)


def _mapped(path: Path) -> None:
    with atomic_path(path) as temporary:
        array = np.lib.format.open_memmap(temporary, "w+", np.float32, (LARGE,))
        with temporary.open("r+b") as file:
            reserve(file, temporary.stat().st_size)
        array[:] = 1


WRITERS = {"text": _text, "torch": _torch, "mapped": _mapped}


@contextmanager
def _small_files(limit: int = LIMIT) -> Iterator[None]:
    """No file may become larger."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.mark.parametrize("writer", WRITERS)
def test_files_that_may_not_become_larger(tmp_path: Path, writer: str) -> None:
    path = tmp_path / "file.ckpt"
    path.write_text("old")
    message = rf"{re.escape(str(path))}: found file too large .*Existing files are unchanged"
    with _small_files(), pytest.raises(NoRoomError, match=message):
        WRITERS[writer](path)
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


class Pictures(lightning.Callback):
    """Logs a picture at every step."""

    def on_train_batch_end(self, trainer: Any, *_: Any) -> None:
        noise = np.random.default_rng(0).integers(0, 256, (3, 200, 200), np.uint8)
        trainer.logger.experiment.add_image("noise", noise, trainer.global_step)


@pytest.mark.filterwarnings("ignore:You defined a `validation_step`:UserWarning")
@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_a_full_disk_for_tensorboard_ends_the_run_with_a_checkpoint(
    stanford_root: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    logger = TensorBoardLogger(tmp_path, name="", version="tensorboard")
    trainer = run_trainer(tmp_path, max_epochs=9, logger=logger, callbacks=[Pictures()])
    data = small_data(stanford_root)
    message = rf"{re.escape(str(tmp_path))}: found file too large"
    before = {*threading.enumerate()}
    with (
        pytest.raises(NoRoomError, match=message),
        _small_files(3 * LIMIT),
        machine_faults(tmp_path, data),
    ):
        trainer.fit(small_task(Faulty()), datamodule=data)
    for thread in {*threading.enumerate()} - before:  # the writer's end belongs to this test
        thread.join(10)
    output = capfd.readouterr().err
    assert f"tangent-train resume={tmp_path}" in output
    content = torch.load(tmp_path / "checkpoints" / "last.ckpt", weights_only=True)
    assert content["state_dict"]
