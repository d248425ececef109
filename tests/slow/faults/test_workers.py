"""Workers of a loader that die or run out of memory: the sample is named, and what to do."""

from __future__ import annotations

import gc
import os
import signal
from functools import partial
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pytest
import torch
from torch.utils.data import get_worker_info

from datamodules.core.watched_samples import explained
from tangent_train.cli.machine import machine_faults
from tangent_train.errors import DataError, SettingError
from tests.slow.faults.small_runs import Faulty, run_trainer, small_data, small_task

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from datamodules.stanford2d3ds.panoramas import Stanford2D3DS

pytestmark = [
    pytest.mark.filterwarnings("ignore:You defined a `validation_step`:UserWarning"),
    # torch opens files to see whether any are left, and hears of the death in the middle of that.
    pytest.mark.filterwarnings("ignore:unclosed file <_io.FileIO name='.*tmp:ResourceWarning"),
]

INDEX = 2


@pytest.fixture(autouse=True)
def _closed() -> Iterator[None]:
    """Files that torch left open are closed here, and not in a test that may not leave any."""
    yield
    gc.collect()


def _die(how: Callable[[], object]) -> object:
    assert get_worker_info() is not None, "only workers"
    return how()


def _kill(number: signal.Signals) -> None:
    os.kill(os.getpid(), number)


DEATHS: dict[str, tuple[Callable[[], object], str, str]] = {
    "killed": (partial(_kill, signal.SIGKILL), "is killed by signal: Killed", "runs out of memory"),
    "bus error": (partial(_kill, signal.SIGBUS), "is killed by signal: Bus error", "/dev/shm"),
    "exited": (partial(os._exit, 3), "exited unexpectedly with exit code 3", "num_workers=0"),
}
SHORTAGES: dict[str, Callable[[], object]] = {
    "numpy": lambda: np.ones(1 << 60, np.uint8),
    "opencv": lambda: cv2.resize(np.zeros((1, 1), np.uint8), (1 << 30, 1 << 24)),
}


def _make_fail(
    data: Stanford2D3DS, split: Any, happens: Callable[[], object], patch: pytest.MonkeyPatch
) -> str:
    """Let it happen where one panorama is read; returns its name."""
    source: Any = data.source(split)
    read = source.read

    def fail(index: int) -> Any:
        if index == INDEX:
            happens()
        return read(index)

    patch.setattr(source, "read", fail)
    return str(source.name(INDEX))


@pytest.mark.parametrize("death", DEATHS)
def test_a_worker_that_dies_while_training_is_reported_with_the_panorama(
    stanford_root: Path,
    tmp_path: Path,
    death: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    how, found, remedy = DEATHS[death]
    data = small_data(stanford_root, num_workers=2)
    name = _make_fail(data, "train", partial(_die, how), monkeypatch)
    task = small_task(Faulty())
    with pytest.raises(DataError) as caught, machine_faults(tmp_path, data):
        run_trainer(tmp_path, max_epochs=1).fit(task, datamodule=data)
    message = str(caught.value)
    assert message.startswith(f"{name}: found a worker process that {found} while it read")
    assert remedy in message
    assert f"tangent-train resume={tmp_path}" in capsys.readouterr().err


def test_a_worker_that_dies_in_the_test_is_reported_likewise(
    stanford_root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = small_data(stanford_root, num_workers=1)
    name = _make_fail(data, "test", partial(_die, DEATHS["killed"][0]), monkeypatch)
    with pytest.raises(DataError, match=name), machine_faults(tmp_path, data):
        run_trainer(tmp_path).test(small_task(Faulty()), datamodule=data, verbose=False)


@pytest.mark.parametrize("workers", [0, 2])
@pytest.mark.parametrize("shortage", SHORTAGES)
def test_too_little_memory_is_reported_with_the_panorama(
    stanford_root: Path,
    tmp_path: Path,
    workers: int,
    shortage: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    data = small_data(stanford_root, num_workers=workers)
    name = _make_fail(data, "train", SHORTAGES[shortage], monkeypatch)
    with pytest.raises(DataError) as caught, machine_faults(tmp_path, data):
        run_trainer(tmp_path, max_epochs=1).fit(small_task(Faulty()), datamodule=data)
    message = str(caught.value)
    assert message.startswith(f"{name}: found too little memory to read it; expected enough.")
    assert "data.num_workers" in message
    assert "Traceback" not in message


def test_errors_of_workers_are_said_without_their_stack(
    stanford_root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse() -> None:
        raise DataError("a.png", found="half of it", expected="all", remedy="Copy it\nagain.")

    data = small_data(stanford_root, num_workers=1)
    _make_fail(data, "train", refuse, monkeypatch)
    with pytest.raises(DataError) as caught, machine_faults(tmp_path, data):
        run_trainer(tmp_path, max_epochs=1).fit(small_task(Faulty()), datamodule=data)
    assert str(caught.value) == "a.png: found half of it; expected all. Copy it\nagain."


def test_other_errors_stay_as_they_are(
    stanford_root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for error in (RuntimeError("something else"), DataError("a"), SettingError("Caught in b")):
        assert explained(error, []) is error
        with pytest.raises(type(error)) as caught, machine_faults(tmp_path, None):
            raise error
        assert caught.value is error
    data = small_data(stanford_root)
    _make_fail(data, "train", lambda: cv2.resize(np.zeros((0, 1)), (2, 2)), monkeypatch)
    with pytest.raises(cv2.error, match="empty"), machine_faults(tmp_path, data):
        run_trainer(tmp_path, max_epochs=1).fit(small_task(Faulty()), datamodule=data)


def test_samples_are_those_without_a_watch(stanford_root: Path) -> None:
    data = small_data(stanford_root, num_workers=2)
    alone = data.training_samples()
    batches = list(data.train_dataloader())
    assert len(batches) == len(alone)
    for batch in batches:
        expected = alone[0, int(batch.index)]
        torch.testing.assert_close(batch.labels[0], expected.labels, rtol=0, atol=0)
        torch.testing.assert_close(batch.images[0][0], expected.images[0], rtol=0, atol=0)
