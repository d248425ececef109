"""Workers of a loader that die or fail: what is said, and what to do."""

from __future__ import annotations

import gc
import os
import signal
from functools import partial
from typing import TYPE_CHECKING, Any

import pytest
from torch.utils.data import get_worker_info

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


@pytest.fixture(autouse=True)
def _closed() -> Iterator[None]:
    """Files that torch left open are closed here, and not in a test that may not leave any."""
    yield
    gc.collect()


def _die(how: Callable[[], object]) -> object:
    assert get_worker_info() is not None, "only workers"
    return how()


DEATHS: dict[str, Callable[[], object]] = {
    "killed": lambda: os.kill(os.getpid(), signal.SIGKILL),
    "exited": partial(os._exit, 3),
}


def _make_fail(
    data: Stanford2D3DS, split: Any, happens: Callable[[], object], patch: pytest.MonkeyPatch
) -> None:
    """Let it happen where one panorama is read."""
    source: Any = data.source(split)
    read = source.read

    def fail(index: int) -> Any:
        if index == 2:
            happens()
        return read(index)

    patch.setattr(source, "read", fail)


@pytest.mark.parametrize("death", DEATHS)
@pytest.mark.parametrize("training", [True, False])
def test_a_worker_that_dies_is_reported_with_what_may_help(
    stanford_root: Path,
    tmp_path: Path,
    death: str,
    training: bool,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    data = small_data(stanford_root, num_workers=2)
    split = "train" if training else "test"
    _make_fail(data, split, partial(_die, DEATHS[death]), monkeypatch)
    trainer = run_trainer(tmp_path, max_epochs=1)
    run: Any = trainer.fit if training else partial(trainer.test, verbose=False)
    message = r"data\.num_workers: found 2, and a DataLoader worker"
    with pytest.raises(SettingError, match=message), machine_faults(tmp_path, data):
        run(small_task(Faulty()), datamodule=data)


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


def test_other_errors_stay_as_they_are(stanford_root: Path, tmp_path: Path) -> None:
    data = small_data(stanford_root)
    for error in (RuntimeError("something else"), DataError("a"), SettingError("Caught in b")):
        with pytest.raises(type(error)) as caught, machine_faults(tmp_path, data):
            raise error
        assert caught.value is error
