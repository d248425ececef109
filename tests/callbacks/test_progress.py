"""Progress without a terminal."""

from __future__ import annotations

import time
from typing import Any

import lightning
import pytest
import torch
from lightning.pytorch.demos.boring_classes import BoringModel

from tangent_train import progress
from tangent_train.callbacks.progress import ProgressBar


class _Model(BoringModel):
    def training_step(self, batch: Any, batch_idx: int) -> Any:
        loss = self.step(batch)
        self.log("train/loss", torch.tensor(0.25), prog_bar=True)
        return loss


def _trainer(**settings: Any) -> lightning.Trainer:
    return lightning.Trainer(
        **{"max_epochs": 2, **settings},
        limit_train_batches=3,
        limit_val_batches=1,
        limit_test_batches=2,
        callbacks=[ProgressBar()],
        accelerator="cpu",
        logger=False,
        enable_checkpointing=False,
        enable_model_summary=False,
    )


def test_a_line_per_epoch(capsys: pytest.CaptureFixture[str]) -> None:
    trainer = _trainer()
    trainer.fit(_Model())
    trainer.test(_Model(), verbose=False)
    first, second = capsys.readouterr().out.splitlines()
    assert first.startswith("Epoch 1 of 2, train/loss 0.250, 0:00:0")
    assert first.endswith(" left")
    assert second == "Epoch 2 of 2, train/loss 0.250"


def test_a_line_whenever_a_minute_has_passed(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    now = 0.0

    def half_a_minute_later() -> float:
        nonlocal now
        now += 30
        return now

    monkeypatch.setattr(time, "monotonic", half_a_minute_later)
    progress.show_progress(iter(range(4)), "Rendering rooms", "rooms", 5, before=1)
    first, *lines = capsys.readouterr().out.splitlines()
    assert first == "Rendering rooms: 1 of 5"
    assert 1 <= len(lines) <= 4
    count, rate, left = lines[0].removeprefix("Rendering rooms: ").split(", ")
    pieces, minutes = int(count[0]) - 1, float(rate.removesuffix(" rooms/min"))
    hours, of_hour, _ = left.split(":")
    assert 0.1 <= minutes <= 2
    assert 60 * int(hours) + int(of_hour) == pytest.approx((4 - pieces) / minutes, rel=0.2)
    trainer = _trainer()
    trainer.test(_Model(), verbose=False)
    assert "Test: 2 of 2 steps" in capsys.readouterr().out
