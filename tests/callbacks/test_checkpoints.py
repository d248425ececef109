from __future__ import annotations

from typing import TYPE_CHECKING

import pytest
import torch

from tangent_train.callbacks.checkpoints import AtomicCheckpointIO, BestCheckpoint, LastCheckpoint
from tangent_train.errors import SettingError

if TYPE_CHECKING:
    from pathlib import Path


def test_the_best_epoch_is_kept_when_the_folder_moves(tmp_path: Path) -> None:
    before, after = BestCheckpoint(tmp_path / "before"), BestCheckpoint(tmp_path / "after")
    path = str(tmp_path / "before" / "best.ckpt")
    before.best_model_path, before.best_model_score = path, torch.tensor(0.6)
    before.best_k_models = {path: torch.tensor(0.6)}
    before.kth_best_model_path = path
    after.load_state_dict(before.state_dict())
    here = str(tmp_path / "after" / "best.ckpt")
    assert after.best_model_path == after.kth_best_model_path == here
    assert after.best_k_models == {here: torch.tensor(0.6)}
    assert after.best_model_score == torch.tensor(0.6)


def test_a_checkpoint_that_cannot_be_written_leaves_the_old_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "last.ckpt"
    AtomicCheckpointIO().save_checkpoint({"step": 1}, path)

    def fail(content: object, file: Path) -> None:
        file.write_bytes(b"half of it")
        raise OSError("no space left")

    monkeypatch.setattr(torch, "save", fail)
    with pytest.raises(OSError, match="no space left"):
        AtomicCheckpointIO().save_checkpoint({"step": 2}, path)
    assert torch.load(path, weights_only=True) == {"step": 1}
    assert [file.name for file in tmp_path.iterdir()] == ["last.ckpt"]


def test_impossible_intervals_are_refused(tmp_path: Path) -> None:
    with pytest.raises(SettingError, match="checkpoint_every_n_steps: found 0"):
        LastCheckpoint(tmp_path, 0)
