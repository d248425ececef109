from __future__ import annotations

import multiprocessing
import os
import socket
from functools import partial
from pathlib import Path
from typing import Any

import lightning
import numpy as np
import pytest
import torch
from torch import Tensor, nn
from torch.multiprocessing.spawn import start_processes
from torch.nn import functional

from models import ShapeClassifier
from tangent_train.errors import SettingError
from tests.tasks.shapes import Shapes, SmallNetwork, quiet_trainer, shape_task


class Gradients(lightning.Callback):
    """Keeps the gradients that the optimizer has used."""

    def on_train_batch_end(self, trainer: Any, pl_module: Any, *_: Any) -> None:
        self.found = [p.grad.clone() for p in pl_module.parameters()]
        self.loss = trainer.callback_metrics["train/loss"]


def _gradients(
    count: int = 4, batch_size: int = 4, trainer: dict[str, Any] | None = None, **settings: Any
) -> tuple[list[Tensor], Tensor]:
    gradients = Gradients()
    used = {"max_steps": 1} | (trainer or {})
    quiet_trainer(limit_val_batches=0, callbacks=[gradients], **used).fit(
        shape_task(label_smoothing=0.1, **settings), datamodule=Shapes(count, batch_size)
    )
    return gradients.found, gradients.loss


def _expected(count: int, smoothing: float = 0.1) -> tuple[list[Tensor], Tensor]:
    """In float64, of the mean cross-entropy written out."""
    network = shape_task().network.double()
    shapes = Shapes(count).shapes
    scores = network(torch.stack([shape.images for shape in shapes]).double())
    logs = scores - scores.exp().sum(dim=1, keepdim=True).log()
    target = torch.full_like(scores, smoothing / 3)
    for row, shape in zip(target, shapes, strict=True):
        row[shape.label] += 1 - smoothing
    loss = -(target * logs).sum() / count
    return list(torch.autograd.grad(loss, list(network.parameters()))), loss.detach()


def _assert_close(found: list[Tensor], expected: list[Tensor], tolerance: float = 1e-5) -> None:
    for one, other in zip(found, expected, strict=True):
        assert float((one.double() - other.double()).norm() / other.double().norm()) < tolerance


@pytest.mark.parametrize("images_per_chunk", [None, 1, 5, 12, 1000])
def test_chunks_give_the_gradient_of_the_whole_batch(images_per_chunk: int | None) -> None:
    found, loss = _gradients(images_per_chunk=images_per_chunk)
    expected, expected_loss = _expected(4)
    _assert_close(found, expected)
    assert float(loss) == pytest.approx(float(expected_loss), rel=1e-5)


@pytest.mark.parametrize(
    ("images_per_chunk", "shapes"), [(None, [4]), (1, [1] * 4), (12, [2, 2]), (15, [3, 1])]
)
def test_chunks_are_whole_shapes(images_per_chunk: int | None, shapes: list[int]) -> None:
    class Counting(SmallNetwork):
        def forward(self, images: Tensor) -> Tensor:
            seen.append(len(images))
            return super().forward(images)

    seen: list[int] = []
    task = shape_task(Counting(), images_per_chunk=images_per_chunk)
    quiet_trainer(max_steps=1, limit_val_batches=0).fit(task, datamodule=Shapes(4, 4))
    assert seen == shapes


def test_accumulated_batches_give_the_mean_of_their_gradients() -> None:
    accumulated = {"max_steps": -1, "max_epochs": 1, "accumulate_grad_batches": 2}
    found, _ = _gradients(4, 2, accumulated, images_per_chunk=5)
    _assert_close(found, _expected(4)[0])


@pytest.mark.filterwarnings("ignore::DeprecationWarning:torch")
def test_faster_arithmetic_works() -> None:
    settings: dict[str, Any] = {"channels_last": True, "compile": {"backend": "aot_eager"}}
    found, _ = _gradients(trainer={"precision": "bf16-mixed"}, images_per_chunk=10, **settings)
    _assert_close(found, _expected(4)[0], tolerance=5e-2)


def test_a_tiny_set_is_learned_by_heart() -> None:
    torch.manual_seed(0)
    network = ShapeClassifier(3, 3, 4)
    task = shape_task(network, optimizer=partial(torch.optim.Adam, lr=1e-2))
    data = Shapes(9, 9)
    trainer = quiet_trainer(max_epochs=40, limit_val_batches=0)
    trainer.fit(task, datamodule=data)
    (figures,) = trainer.test(task, datamodule=data, verbose=False)
    assert figures["test/accuracy"] == figures["test/class_accuracy"] == 1
    np.testing.assert_array_equal(task.matrix, 3 * np.eye(3))
    assert float(trainer.callback_metrics["test/accuracy"]) == 1


class Oracle(nn.Module):
    """Takes class 0 and 1 for themselves and class 2 for 0; counts the classes by their channel."""

    def forward(self, images: Tensor) -> Tensor:
        brightest = images.mean(dim=(1, 3, 4)).argmax(dim=1)
        return functional.one_hot(brightest % 2, 3).float()


def test_every_shape_is_counted_once_in_integers() -> None:
    task = shape_task(Oracle())
    data = Shapes(10)  # 4 of class 0, 3 of 1, 3 of 2
    (figures,) = quiet_trainer().test(task, datamodule=data, verbose=False)
    np.testing.assert_array_equal(task.matrix, [[4, 0, 0], [0, 3, 0], [3, 0, 0]])
    assert task.matrix.dtype == np.int64
    assert figures["test/accuracy"] == pytest.approx(0.7)
    assert figures["test/class_accuracy"] == pytest.approx(2 / 3)
    (figures,) = quiet_trainer().validate(task, datamodule=data, verbose=False)
    assert set(figures) == {"val/accuracy", "val/class_accuracy"}
    assert task.matrix.sum() == 10, "counted anew"


@pytest.mark.parametrize(
    ("network", "found"),
    [
        (SmallNetwork(classes=4), r"\(2, 4\)"),
        (nn.Identity(), r"\(2, 5, 3, 16, 16\)"),
        (nn.Sequential(nn.Flatten(0), nn.Unflatten(0, (3, -1))), r"\(3, 2560\)"),
    ],
)
def test_scores_that_do_not_fit_are_refused(network: nn.Module, found: str) -> None:
    task = shape_task(network)
    message = rf"scores of the network: found {found}; expected \(2, 3\)"
    with pytest.raises(SettingError, match=message):
        task(torch.zeros(2, 5, 3, 16, 16))


def test_the_example_has_all_views_of_one_shape() -> None:
    assert shape_task().example(6).shape == (1, 20, 6, 16, 16)


@pytest.mark.parametrize("settings", [{"label_smoothing": 1}, {"images_per_chunk": 0}])
def test_impossible_settings_are_refused(settings: dict[str, Any]) -> None:
    with pytest.raises(SettingError, match=f"task.{next(iter(settings))}: found"):
        shape_task(**settings)


def _one_of_two(rank: int, port: int, folder: Path) -> None:
    """A training step and a test as one of two processes that somebody else has started."""
    os.environ |= {
        "MASTER_ADDR": "127.0.0.1",
        "MASTER_PORT": str(port),
        "LOCAL_RANK": str(rank),
        "NODE_RANK": "0",
        "WORLD_SIZE": "2",
    }
    gradients = Gradients()
    trainer = quiet_trainer(
        max_steps=1, limit_val_batches=0, strategy="ddp", devices=2, callbacks=[gradients]
    )
    task = shape_task(label_smoothing=0.1, images_per_chunk=5)
    trainer.fit(task, datamodule=Shapes(4, 2, rank, 2))
    test = quiet_trainer(strategy="ddp", devices=2)
    tested = shape_task(Oracle())
    tested.anchor = nn.Parameter(torch.zeros(1))  # DDP wants something to learn
    (figures,) = test.test(tested, datamodule=Shapes(5, rank=rank, processes=2), verbose=False)
    content = {
        "gradients": gradients.found,
        "loss": gradients.loss,
        "matrix": torch.tensor(tested.matrix),
        "figures": figures,
    }
    torch.save(content, folder / f"{rank}.pt")


@pytest.mark.slow
def test_two_processes_take_the_step_of_one_and_count_every_shape_once(tmp_path: Path) -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    multiprocessing.set_forkserver_preload([__name__])  # imported once, not once per process
    start_processes(_one_of_two, (port, tmp_path), nprocs=2, start_method="forkserver")  # type: ignore[no-untyped-call]
    expected, loss = _expected(4)
    for rank in range(2):
        found = torch.load(tmp_path / f"{rank}.pt", weights_only=True)
        _assert_close(found["gradients"], expected)
        assert float(found["loss"]) == pytest.approx(float(loss), rel=1e-5)
        assert found["matrix"].tolist() == [[2, 0, 0], [0, 2, 0], [1, 0, 0]]
        assert found["figures"]["test/accuracy"] == pytest.approx(0.8)
        assert found["figures"]["test/class_accuracy"] == pytest.approx(2 / 3)
