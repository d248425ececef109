"""A training step does not wait for the GPU, and an evaluation stays there."""

from __future__ import annotations

from functools import partial

import pytest
import torch
from torch import nn

from datamodules.core.inputs import RGBD_NORMALIZATION, normalize
from models import AuxiliaryHead, UNet
from tangent_train.rendering import Blend, TangentRepresentation
from tangent_train.tasks import PixelTask
from tests.fake_gpu import fake_gpu
from tests.models.sphere_networks import STAGE
from tests.tasks.builders import predict_labels, segmentation_task

SHAPE = (64, 128)


def _segmentation(network: nn.Module, blend: Blend = "nearest") -> PixelTask:
    representation = TangentRepresentation(base_level=0, level=5, blend=blend)
    names = ("unknown", *"abcd")
    return segmentation_task(network, representation, names, partial(torch.optim.SGD, lr=0.1))


def _unet() -> nn.Module:
    return UNet(4, 4, [4, 6, 8])


@pytest.mark.parametrize(
    "network",
    [_unet(), AuxiliaryHead(_unet(), STAGE, 4, 4)],
    ids=["unet", "auxiliary head"],
)
def test_a_training_step_neither_copies_nor_waits(network: nn.Module) -> None:
    task = _segmentation(network).train()
    with fake_gpu(task) as transfers:
        views = torch.empty(2, 5, 32, 32, 3, dtype=torch.uint8)
        depth, labels = views[..., 0].to(torch.int16), views[..., 0].flatten(0, 1)
        images = normalize((views, depth), RGBD_NORMALIZATION, ("rgb", "depth")).flatten(0, 1)
        loss = task.loss_sum(task(images), labels) / task.head.loss_norm(labels)
    assert (loss.device.type, transfers) == ("cuda", [])


@pytest.mark.parametrize("blend", ["nearest", "feather"])
def test_an_evaluation_copies_nothing_back(blend: Blend) -> None:
    """Only tables of the geometry are copied to the GPU."""
    task = _segmentation(_unet(), blend).eval()
    with fake_gpu(task) as transfers:
        labels = predict_labels(task, torch.empty(20, 4, 32, 32), SHAPE)
    assert (labels.device.type, tuple(labels.shape)) == ("cuda", SHAPE)
    assert set(transfers) <= {"from {'cpu'} to {'cuda'}"}
