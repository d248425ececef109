"""One's own data set from the command line: check, train, evaluate, without code."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.cli.tiny_runs import results, run_command
from tests.datamodules.folder.folder_format import (
    write_data_set,
)

_ROWS = 32
_TEST = ["scene_3/view.0", "scene_3/view.1"]
_SETTINGS = [
    "data=folder",
    "level=4",
    "network=unet_small",
    "network.widths=[4,8]",
    "representation.base_level=0",
    "data.panoramas_per_step=2",
    "data.num_workers=0",
    "trainer.max_epochs=1",
    "trainer.accelerator=cpu",
    "panels=1",
]


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("own") / "my rooms"
    write_data_set(folder, scenes=5, each=2, height=_ROWS, depth=True)
    (folder / "test.txt").write_text("\n".join(_TEST))
    return folder


def test_two_panoramas_train_and_the_last_epoch_is_tested(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    root = write_data_set(tmp_path / "few", scenes=2, each=1, height=_ROWS)
    run_command(monkeypatch, "train", *_SETTINGS, f"data.root={root}", "hydra.run.dir=run")
    checkpoints = tmp_path / "run" / "checkpoints"
    first = (checkpoints / "best.ckpt").read_bytes()
    assert first == (checkpoints / "last.ckpt").read_bytes()
    run_command(monkeypatch, "train", "resume=run", f"data.root={root}", "trainer.max_epochs=2")
    assert first != (checkpoints / "best.ckpt").read_bytes()
    assert results(tmp_path / "run")["images"] == 1
