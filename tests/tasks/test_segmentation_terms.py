"""The loss of an auxiliary head, and networks that know where they look."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional
from torch.utils.data import DataLoader

from tangent_train.rendering import TangentRepresentation
from tangent_train.tasks import SegmentationTask
from tests.tasks.shapes import quiet_trainer

NAMES = ("unknown", "a", "b")
WEIGHTS = torch.tensor([0.0, 1.0, 3.0])
TANGENT = TangentRepresentation(0, 4, average_rotations=2)

pytestmark = pytest.mark.filterwarnings("ignore:You defined a `validation_step`:UserWarning")


class TwoHeads(nn.Module):
    """Scores of the pixels, and of cells of 4×4 pixels while training."""

    def __init__(self) -> None:
        super().__init__()
        self.pixels = nn.Conv2d(2, 3, 1)
        self.cells = nn.Conv2d(2, 3, 4, stride=4)

    def forward(self, images: Tensor) -> Any:
        scores = self.pixels(images)
        return {"out": scores, "aux": self.cells(images)} if self.training else scores


def _batch(seed: int = 0) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    images = torch.randn(6, 2, 16, 16, generator=generator)
    labels = torch.randint(0, 3, (6, 16, 16), generator=generator).to(torch.uint8)
    labels[1] = 0
    return images, labels


@pytest.mark.parametrize("weight", [0.0, 0.4])
def test_the_auxiliary_head_adds_the_loss_of_its_cells(weight: float) -> None:
    images, labels = _batch()
    torch.manual_seed(0)
    optimizer = partial(torch.optim.SGD, lr=0.1)
    task = SegmentationTask(TwoHeads(), TANGENT, NAMES, optimizer, auxiliary_weight=weight)
    task.class_weights.copy_(WEIGHTS)
    found = task.loss_sum((images,), labels) / task.loss_norm(labels)
    outputs = task.network(images)
    mean = partial(functional.cross_entropy, weight=WEIGHTS, ignore_index=0)
    enlarged = outputs["aux"].repeat_interleave(4, 2).repeat_interleave(4, 3)
    expected = mean(outputs["out"], labels.long()) + weight * mean(enlarged, labels.long())
    torch.testing.assert_close(found, expected)


# Networks that are told where their images look.


class Training(NamedTuple):
    images: Tensor
    labels: Tensor
    rays: Tensor


class Evaluation(NamedTuple):
    images: Tensor
    target: Tensor
    rays: Tensor
    rotations: Tensor


class Looking(nn.Module):
    """Says that what is above is `a` and what is below is `b`, by the rays alone."""

    def __init__(self) -> None:
        super().__init__()
        self.scale = nn.Parameter(torch.tensor(0.1))
        self.told: list[tuple[tuple[int, ...], int | None]] = []

    def forward(
        self, images: Tensor, rays: Tensor | None = None, images_per_chunk: int | None = None
    ) -> Tensor:
        if rays is None:
            rays = torch.eye(3).expand(len(images), 1, 3, 3)
        self.told.append((tuple(rays.shape), images_per_chunk))
        height, width = images.shape[-2:]
        y, x = torch.meshgrid(_centers(height), _centers(width), indexing="ij")
        pixels = torch.stack([x, y, torch.ones_like(x)], dim=-1)
        up = torch.einsum("nwc,ijc->nijw", rays.flatten(0, 1), pixels)[..., 2]
        return self.scale * torch.stack([up.abs() + 1, up, -up], dim=1)


def _centers(count: int) -> Tensor:
    return (2 * torch.arange(count) + 1) / count - 1


def test_training_tells_such_a_network_where_all_images_look_and_leaves_the_chunks_to_it() -> None:
    network = Looking()
    task = SegmentationTask(
        network,
        TANGENT,
        NAMES,
        partial(torch.optim.SGD, lr=0.1),
        class_weights=WEIGHTS.tolist(),
        images_per_chunk=3,
    )
    images, labels = _batch()
    samples: Any = [Training(i, k, torch.eye(3).expand(3, 3, 3)) for i, k in
                    zip(torch.split(images, 3), torch.split(labels, 3), strict=True)]  # fmt: skip
    quiet_trainer(max_steps=1, limit_val_batches=0).fit(task, DataLoader(samples, 2))
    assert network.told == [((2, 3, 3, 3), 3)]


def test_evaluation_tells_it_the_rays_of_every_turn() -> None:
    network = Looking()
    task = SegmentationTask(
        network, TANGENT, NAMES, partial(torch.optim.SGD, lr=0.1), images_per_forward=7
    )
    target = torch.ones(32, 64, dtype=torch.uint8)
    target[16:] = 2
    views = TANGENT.whole()
    where = torch.tensor(views.rays()), torch.tensor(views.rotations())
    samples: Any = [Evaluation(torch.zeros(40, 2, 16, 16), target, *where)]
    quiet_trainer().test(task, DataLoader(samples), verbose=False)
    assert network.told == [((1, 20, 3, 3), 7)] * 2
    pixels = task.matrices.pixels
    assert pixels[1, 1] + pixels[2, 2] == pixels.sum() == 32 * 64
