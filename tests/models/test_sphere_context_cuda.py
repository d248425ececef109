"""Context on a GPU: the same scores as on the CPU, and the same dropout in every run of a chunk."""

from __future__ import annotations

import copy

import pytest
import torch
from torch import Tensor, nn

from models import SphereContext
from tests.models.sphere_networks import ATTENTION, awake, small_context, sphere_rays

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device"),
]


def test_scores_and_gradients_are_those_of_the_cpu() -> None:
    context = small_context().double().eval()
    images, rays = torch.randn(6, 3, 16, 16).double(), sphere_rays(3, 2).double()
    for size in (None, 4):
        results = []
        for device in ("cpu", "cuda"):
            moved = copy.deepcopy(context).to(device)
            scores = moved(images.to(device), rays.to(device), size)
            scores.square().sum().backward()
            gradients = [p.grad.cpu() for p in moved.parameters() if p.grad is not None]
            results.append([scores.cpu(), *gradients])
        torch.testing.assert_close(results[1], results[0])


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_half_precision(dtype: torch.dtype) -> None:
    context = small_context().cuda().eval()
    images, rays = torch.randn(4, 3, 16, 16).cuda(), sphere_rays(4).cuda()
    with torch.no_grad():
        expected = context(images, rays)
        with torch.autocast("cuda", dtype):
            for found in (context(images, rays), context(images, rays, 3)):
                torch.testing.assert_close(found.float(), expected, rtol=0.1, atol=0.1)


def test_a_chunk_drops_out_the_same_in_every_run() -> None:
    encoder = nn.Sequential(nn.Conv2d(3, 8, 1), nn.Dropout(0.5))
    network = nn.Sequential(encoder, nn.Conv2d(8, 4, 1))
    context = SphereContext(network, "0", ATTENTION, in_channels=3).cuda().train()
    awake(context.mixer)
    dropped: list[Tensor] = []
    encoder[1].register_forward_hook(lambda _m, _i, result: dropped.append(result == 0))
    images = torch.randn(6, 3, 8, 8).cuda()
    state = torch.cuda.get_rng_state()
    context(images, sphere_rays(6).cuda(), 3).square().sum().backward()
    assert torch.equal(torch.cuda.get_rng_state(), state)
    # Two chunks, each encoded and decoded, and both again for the gradient.
    assert len(dropped) == 8
    assert not torch.equal(dropped[0], dropped[1])
    assert sum(torch.equal(run, dropped[0]) for run in dropped) == 4
    assert sum(torch.equal(run, dropped[1]) for run in dropped) == 4
