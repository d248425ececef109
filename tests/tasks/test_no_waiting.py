"""On a GPU, tensors that are not there are an error, and a step does not wait for the host.

Tensors of `FakeTensorMode` have a device and a shape and no numbers: no GPU is needed, and whatever
has to read a number (`item`, `nonzero`, `bincount`), which would wait for a GPU, is an error.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from datamodules.core.inputs import RGBD_NORMALIZATION, normalize
from models import AuxiliaryHead, UNet
from tangent_train.rendering import Blend, TangentRepresentation
from tangent_train.tasks import SegmentationTask
from tests.models.sphere_networks import STAGE, small_context

SHAPE = (64, 128)


class _Transfers(TorchDispatchMode):  # type: ignore[no-untyped-call]
    """Lists operations whose result is on another device than what they were given."""

    def __init__(self) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self.found: list[str] = []

    def __torch_dispatch__(self, operation: Any, _: Any, given: Any = (), named: Any = None) -> Any:
        result = operation(*given, **(named or {}))
        before, after = (
            {leaf.device.type for leaf in tree_leaves(part) if isinstance(leaf, Tensor)}
            for part in ((given, named), result)
        )
        if before and after and before != after:
            self.found.append(f"{operation} from {before} to {after}")
        return result


@contextmanager
def _gpu(module: nn.Module) -> Iterator[list[str]]:
    """The module and new tensors are on a GPU; gives the transfers between devices."""
    fake = FakeTensorMode(allow_non_fake_inputs=True)
    with fake, torch.device("cuda"), _Transfers() as transfers:
        for part in module.modules():
            for held in (part._parameters, part._buffers):
                found: Any = {name: t for name, t in held.items() if t is not None}
                held.update({name: torch.empty_like(t, device="cuda") for name, t in found.items()})
        transfers.found.clear()
        yield transfers.found


def _segmentation(network: nn.Module, blend: Blend = "nearest") -> SegmentationTask:
    representation = TangentRepresentation(base_level=0, level=5, blend=blend)
    names = ("unknown", *"abcd")
    return SegmentationTask(network, representation, names, partial(torch.optim.SGD, lr=0.1))


def _unet() -> nn.Module:
    return UNet(4, 4, [4, 6, 8])


@pytest.mark.parametrize(
    "network",
    [_unet(), AuxiliaryHead(_unet(), STAGE, 4, 4), small_context(_unet(), in_channels=4)],
    ids=["unet", "auxiliary head", "context"],
)
def test_a_training_step_neither_copies_nor_waits(network: nn.Module) -> None:
    task = _segmentation(network).train()
    with _gpu(task) as transfers:
        views = torch.empty(2, 5, 32, 32, 3, dtype=torch.uint8)
        depth, labels = views[..., 0].to(torch.int16), views[..., 0].flatten(0, 1)
        images = normalize((views, depth), RGBD_NORMALIZATION, ("rgb", "depth")).flatten(0, 1)
        inputs = (images, torch.empty(2, 5, 3, 3)) if task.sees_rays else (images,)
        loss = task.loss_sum(inputs, labels) / task.loss_norm(labels)
    assert (loss.device.type, transfers) == ("cuda", [])


@pytest.mark.parametrize("blend", ["nearest", "feather"])
def test_an_evaluation_copies_nothing_back(blend: Blend) -> None:
    """Only tables of the geometry are copied to the GPU."""
    task = _segmentation(_unet(), blend).eval()
    with _gpu(task) as transfers:
        labels = task.predict_labels(torch.empty(20, 4, 32, 32), SHAPE)
    assert (labels.device.type, tuple(labels.shape)) == ("cuda", SHAPE)
    assert all(found.endswith("from {'cpu'} to {'cuda'}") for found in transfers)
