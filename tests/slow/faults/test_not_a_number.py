"""NaN in losses and weights: the training stops before the network or a checkpoint is harmed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from lightning.pytorch.plugins import MixedPrecision

from tangent_train.errors import SettingError
from tests.running import run_python
from tests.slow.faults.small_runs import Faulty, run_trainer, small_data, small_task

pytestmark = pytest.mark.filterwarnings("ignore:You defined a `validation_step`:UserWarning")


def _last(folder: Path) -> dict[str, Any]:
    path = folder / "checkpoints" / "last.ckpt"
    content: dict[str, Any] = torch.load(path, weights_only=True)
    return content


@pytest.mark.parametrize(
    ("trainer", "settings", "at", "step", "value"),
    [
        ({}, {"view_batch_size": 7}, 2 * 3 + 1, 2, torch.inf),  # not the last part of its step
        ({"accumulate_grad_batches": 2}, {}, 3, 1, torch.nan),  # the second batch of the step
    ],
    ids=["in chunks", "accumulated"],
)
def test_a_loss_that_is_not_finite_stops_before_the_step(
    stanford_root: Path,
    tmp_path: Path,
    trainer: dict[str, Any],
    settings: dict[str, Any],
    at: int,
    step: int,
    value: float,
) -> None:
    network = Faulty(at, lambda scores: scores.index_fill(1, torch.tensor([1]), value))
    data = small_data(stanford_root)
    with pytest.raises(SettingError, match=r"found (nan|inf); expected finite") as caught:
        run_trainer(tmp_path, max_epochs=1, checkpoint_every=1, **trainer).fit(
            small_task(network, **settings), datamodule=data
        )
    batches = step * trainer.get("accumulate_grad_batches", 1) + (1 if trainer else 0)
    name = data.dataset("train").name(int(list(data.train_dataloader())[batches].index))
    place = f"loss of step {step} (epoch 0, {name})"
    for word in (place, "optimizer.lr", "trainer.gradient_clip_val"):
        assert word in str(caught.value)
    torch.testing.assert_close(network.layer.weight.detach(), network.weights[at], rtol=0, atol=0)
    assert _last(tmp_path)["global_step"] == step


def test_scores_beyond_half_precision_stop_and_another_precision_is_named(
    stanford_root: Path, tmp_path: Path
) -> None:
    network = Faulty(1, lambda scores: scores * 1e6)  # beyond 65504
    half = MixedPrecision("16-mixed", "cpu", torch.amp.GradScaler("cpu"))
    trainer = run_trainer(tmp_path, plugins=[half], max_steps=4)
    with pytest.raises(SettingError, match=r"loss of step 1 .* trainer\.precision=bf16-mixed"):
        trainer.fit(small_task(network), datamodule=small_data(stanford_root))


ONE_OF_TWO = """
import os
import torch
from tangent_train.cli.main import train
from tangent_train.tasks import PixelTask

original = PixelTask.loss_sum

def loss_sum(self, outputs, labels):
    sums = original(self, outputs, labels)
    wrong = self.training and self.trainer.global_step == 2 and os.environ.get("LOCAL_RANK") == "1"
    return sums * torch.nan if wrong else sums

PixelTask.loss_sum = loss_sum
if __name__ == "__main__":
    train()
"""


def test_all_processes_stop_when_the_loss_of_one_is_nan(
    stanford_root: Path, tmp_path: Path
) -> None:
    (tmp_path / "one_of_two.py").write_text(ONE_OF_TWO)
    arguments = [
        "data=stanford2d3ds", f"data.root={stanford_root}", "level=4", "network=unet_small",
        "representation.crop_multiple=null", "data.batch_size=1", "data.num_workers=0",
        "trainer=ddp", "trainer.accelerator=cpu", "trainer.devices=2", "trainer.max_epochs=2",
        "panels=0", "data.val_fraction=0.3", "hydra.run.dir=run",
    ]  # fmt: skip
    done = run_python(tmp_path, "one_of_two.py", *arguments)
    assert done.returncode == 1
    assert "loss of step 2" in done.stderr
    assert "Traceback" not in done.stderr
    assert _last(tmp_path / "run")["global_step"] == 0
