"""Training and evaluation on a GPU are those on the CPU."""

from __future__ import annotations

import inspect
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from models import UNet
from tangent_train.rendering import TangentRepresentation
from tangent_train.tasks import PixelTask
from tests.tasks.builders import predict_labels, segmentation_task
from tests.tasks.shapes import quiet_trainer
from tests.tasks.test_segmentation import NAMES, Data

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device"),
    pytest.mark.filterwarnings("ignore:You defined a `validation_step`:UserWarning"),
    pytest.mark.filterwarnings("ignore:TensorFloat32 tensor cores:UserWarning"),
    # The compiler of torch 2.11 imports a module that uses it.
    pytest.mark.filterwarnings("ignore:`torch.jit.script_method` is deprecated:DeprecationWarning"),
]


@pytest.fixture(autouse=True)
def _without_tf32(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.backends.cudnn, "allow_tf32", False)


def _task(**settings: Any) -> PixelTask:
    torch.manual_seed(0)
    representation = TangentRepresentation(base_level=0, level=4)
    optimizer = partial(torch.optim.SGD, lr=0.1)
    return segmentation_task(UNet(2, 2, [4, 8]), representation, NAMES, optimizer, **settings)


def _trained(accelerator: str, **settings: Any) -> PixelTask:
    task, data = _task(view_batch_size=17), Data()
    quiet = {"max_steps": 2, "max_epochs": 2, "limit_val_batches": 0, "devices": 1}
    trainer = quiet_trainer(accelerator=accelerator, **quiet, **settings)
    trainer.fit(task, datamodule=data)
    trainer.test(task, datamodule=data, verbose=False)
    return task.cpu()


def _weights(task: nn.Module) -> Tensor:
    return torch.cat([parameter.detach().flatten() for parameter in task.parameters()])


def test_two_steps_and_a_test() -> None:
    expected, found = _trained("cpu"), _trained("gpu")
    torch.testing.assert_close(_weights(found), _weights(expected), rtol=1e-4, atol=1e-5)
    counted = expected.result.pixels
    assert np.abs(found.result.pixels - counted).sum() < 0.01 * counted.sum()


@pytest.mark.parametrize("precision", ["bf16-mixed", "16-mixed"])
def test_mixed_precision_is_close_to_float32(precision: str) -> None:
    expected, found = _trained("cpu"), _trained("gpu", precision=precision)
    torch.testing.assert_close(_weights(found), _weights(expected), rtol=0.05, atol=0.05)


def test_cuda_graphs_in_evaluation(monkeypatch: pytest.MonkeyPatch) -> None:
    """They write every result to the same memory."""
    # The checks of shapes while tests run cannot be compiled by torch 2.11.
    monkeypatch.setattr(UNet, "forward", inspect.unwrap(UNet.forward))
    images = torch.randn(20, 2, 16, 16, device="cuda")
    plain = _task(eval_view_batch_size=5).cuda().eval()
    graphs = _task(eval_view_batch_size=5, compile={"mode": "reduce-overhead"}).cuda().eval()
    labels = [predict_labels(task, images, (32, 64)) for task in (plain, graphs, graphs)]
    for found in labels[1:]:
        assert (found == labels[0]).double().mean() > 0.99
