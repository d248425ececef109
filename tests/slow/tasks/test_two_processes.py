"""Two real processes take the step of one."""

from __future__ import annotations

import multiprocessing
import os
import socket
from pathlib import Path

import pytest
import torch
from torch import nn
from torch.multiprocessing.spawn import start_processes

from tests.tasks.shapes import Shapes, quiet_trainer, shape_task
from tests.tasks.test_classification import Gradients, Oracle, assert_close, expected_gradients


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
        "matrix": torch.tensor(tested.matrices),
        "figures": figures,
    }
    torch.save(content, folder / f"{rank}.pt")


def test_two_processes_take_the_step_of_one_and_count_every_shape_once(tmp_path: Path) -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    multiprocessing.set_forkserver_preload([__name__])  # imported once, not once per process
    start_processes(_one_of_two, (port, tmp_path), nprocs=2, start_method="forkserver")  # type: ignore[no-untyped-call]
    expected, loss = expected_gradients(4)
    for rank in range(2):
        found = torch.load(tmp_path / f"{rank}.pt", weights_only=True)
        assert_close(found["gradients"], expected)
        assert float(found["loss"]) == pytest.approx(float(loss), rel=1e-5)
        assert found["matrix"].tolist() == [[2, 0, 0], [0, 2, 0], [1, 0, 0]]
        assert found["figures"]["test/accuracy"] == pytest.approx(0.8)
        assert found["figures"]["test/class_accuracy"] == pytest.approx(2 / 3)
