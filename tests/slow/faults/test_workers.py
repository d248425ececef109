"""Loader workers that are killed or fail: messages and remedies."""

from __future__ import annotations

import gc
import os
import signal
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from torch.utils.data import get_worker_info

from tangent_train.cli.run import machine_faults
from tangent_train.errors import SettingError
from tests.slow.faults.small_runs import Faulty, run_trainer, small_data, small_task

pytestmark = [
    pytest.mark.filterwarnings("ignore:You defined a `validation_step`:UserWarning"),
    # torch opens files to see whether any are left, and hears of the death in the middle of that.
    pytest.mark.filterwarnings("ignore:unclosed file <_io:ResourceWarning"),
    pytest.mark.filterwarnings(
        "ignore:Exception ignored in. <_io:pytest.PytestUnraisableExceptionWarning"
    ),
]


@pytest.fixture(autouse=True)
def _closed() -> Iterator[None]:
    """Files that torch left open are closed here, and not in a test that may not leave any."""
    yield
    gc.collect()


@pytest.mark.parametrize("split", ["train", "test"])
def test_a_worker_that_dies_is_reported_with_what_may_help(
    stanford_root: Path,
    tmp_path: Path,
    split: Any,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    data = small_data(stanford_root, num_workers=2)
    source: Any = data.dataset(split)
    read = source.read

    def read_or_die(index: int) -> Any:
        if index == 2:
            assert get_worker_info() is not None, "only workers"
            os.kill(os.getpid(), signal.SIGKILL) if split == "train" else os._exit(3)
        return read(index)

    monkeypatch.setattr(source, "read", read_or_die)
    trainer = run_trainer(tmp_path, max_epochs=1)
    run: Any = trainer.fit if split == "train" else partial(trainer.test, verbose=False)
    message = r"data\.num_workers: found 2, and a DataLoader worker"
    with pytest.raises(SettingError, match=message), machine_faults(tmp_path, data):
        run(small_task(Faulty()), datamodule=data)
