"""Training in chunks against training at once: gradients, batch statistics, dropout, memory."""

from __future__ import annotations

import copy
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from models import AuxiliaryHead, SphereContext
from tests.models.sphere_networks import ATTENTION, STAGE, awake, small_context, sphere_rays


class _Dropping(nn.Module):
    """Drops out before the stage and behind it, and keeps what it dropped."""

    def __init__(self) -> None:
        super().__init__()
        self.encode = nn.Sequential(nn.Conv2d(3, 8, 1), nn.Dropout(0.5))
        self.decode = nn.Sequential(nn.Dropout(0.5), nn.Conv2d(8, 4, 1))
        self.drawn: list[Tensor] = []

    def forward(self, images: Tensor) -> Tensor:
        features = self.encode(images)
        self.drawn.append(self.encode[0](images) * 2 == features)
        scores: Tensor = self.decode(features)
        return scores


def _gradients(
    context: nn.Module, images: Tensor, rays: Tensor | None, size: int | None
) -> tuple[Any, dict[str, Tensor]]:
    """Scores, and gradients of a function of them that no two pixels have the same share in."""
    context.zero_grad()
    scores = context(images, rays, images_per_chunk=size)
    named = scores if isinstance(scores, dict) else {"out": scores}
    generator = torch.Generator().manual_seed(0)
    loss: Any = torch.zeros((), dtype=images.dtype)
    for tensor in named.values():
        weight = torch.randn(tensor.shape, generator=generator, dtype=images.dtype)
        loss = loss + (tensor.square() * weight).sum()
    loss.backward()
    found = {n: p.grad.clone() for n, p in context.named_parameters() if p.grad is not None}
    return scores, found


def _with_kept_statistics(context: nn.Module) -> nn.Module:
    for module in context.modules():
        if isinstance(module, nn.BatchNorm2d):
            module.eval()
    return context


@pytest.mark.parametrize("size", [1, 3, 7, 100])
def test_gradients_are_those_of_all_at_once(size: int) -> None:
    context = _with_kept_statistics(small_context().double().train())
    images = torch.randn(8, 3, 16, 16, dtype=torch.float64)
    rays = sphere_rays(4, 2).double()
    scores, expected = _gradients(context, images, rays, None)
    found_scores, found = _gradients(context, images, rays, size)
    torch.testing.assert_close(found_scores, scores, rtol=1e-9, atol=1e-9)
    assert found.keys() == expected.keys() == dict(context.named_parameters()).keys()
    torch.testing.assert_close(found, expected, rtol=1e-7, atol=1e-9)


def test_an_auxiliary_head_sees_the_context_and_learns_the_same() -> None:
    head = AuxiliaryHead(small_context().network, STAGE, 3, 4)
    module = SphereContext(head, f"network.{STAGE}", ATTENTION, in_channels=3)
    without = module.train()(torch.ones(6, 3, 16, 16), sphere_rays(3, 2))["aux"]
    awake(module.mixer)
    found = module(torch.ones(6, 3, 16, 16), sphere_rays(3, 2))["aux"]
    assert not torch.allclose(found, without, atol=1e-3)
    _with_kept_statistics(module.double().train())
    images = torch.randn(6, 3, 16, 16, dtype=torch.float64)
    scores, expected = _gradients(module, images, sphere_rays(3, 2), None)
    found_scores, found = _gradients(module, images, sphere_rays(3, 2), 4)
    assert list(scores) == list(found_scores) == ["out", "aux"]
    torch.testing.assert_close(found_scores, scores)
    torch.testing.assert_close(found, expected, rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize("momentum", [0.1, None])
def test_statistics_take_every_chunk_in_once(momentum: float | None) -> None:
    context = small_context().train()
    for module in context.modules():
        if isinstance(module, nn.BatchNorm2d):
            module.momentum = momentum
    nn.init.zeros_(context.mixer.get_parameter("output.weight"))
    plain = copy.deepcopy(context.network)
    images = torch.randn(8, 3, 16, 16)
    for _ in range(2):
        _gradients(context, images, sphere_rays(8), 4)
        for part in torch.split(images, 4):
            plain(part)
    expected = dict(plain.named_buffers())
    assert expected
    for name, buffer in context.network.named_buffers():
        torch.testing.assert_close(buffer, expected[name], msg=name)
        if name.endswith("num_batches_tracked"):
            assert int(buffer) == 4


def test_evaluation_and_errors_leave_no_traces() -> None:
    context = small_context().eval()
    before = {name: buffer.clone() for name, buffer in context.named_buffers()}
    state = torch.get_rng_state()
    context(torch.ones(4, 3, 16, 16), sphere_rays(4), 3)
    assert torch.equal(torch.get_rng_state(), state), "evaluation draws nothing"
    context.train()
    with pytest.raises(RuntimeError):
        context(torch.randn(4, 5, 16, 16), sphere_rays(4), 3)
    assert all(m.momentum == 0.1 for m in context.modules() if isinstance(m, nn.BatchNorm2d))
    torch.testing.assert_close(dict(context.named_buffers()), before, rtol=0, atol=0)


def test_a_chunk_drops_out_the_same_in_every_run() -> None:
    network = _Dropping()
    context = SphereContext(network, "encode", ATTENTION, in_channels=3, tokens=2).train()
    awake(context.mixer)
    torch.manual_seed(3)
    images = torch.randn(6, 3, 8, 8)
    encoded: list[Tensor] = []

    def keep(_module: nn.Module, _inputs: Any, result: Tensor) -> None:
        encoded.append(result == 0)

    network.encode[1].register_forward_hook(keep)
    state = torch.get_rng_state()
    _, gradients = _gradients(context, images, sphere_rays(6), 3)
    after = torch.get_rng_state()
    # Two chunks: encoded, decoded, then both again for the gradient, the last one first.
    assert len(encoded) == 8
    first, second = encoded[0], encoded[1]
    assert not torch.equal(first, second), "chunks draw differently"
    runs = [torch.equal(run, first) for run in encoded]
    assert [torch.equal(run, second) for run in encoded] == [not same for same in runs]
    assert sum(runs) == 4
    assert 0.3 < float(first.float().mean()) < 0.7
    torch.set_rng_state(state)
    _, again = _gradients(context, images, sphere_rays(6), 3)
    torch.testing.assert_close(again, gradients, rtol=0, atol=0)
    assert torch.equal(torch.get_rng_state(), after)
    assert not torch.equal(after, state), "the next step draws something else"


def test_only_one_chunk_is_kept_for_the_gradient() -> None:
    context, images, rays = small_context().train(), torch.randn(16, 3, 32, 32), sphere_rays(16)

    def kept_bytes(size: int | None) -> int:
        """Of tensors that the graph holds between the forward and the backward pass."""
        storages: dict[int, int] = {}

        def pack(tensor: Tensor) -> Tensor:
            storage = tensor.untyped_storage()
            storages[storage.data_ptr()] = storage.nbytes()
            return tensor

        with torch.autograd.graph.saved_tensors_hooks(pack, lambda tensor: tensor):
            scores = context(images, rays, size)
        assert scores.requires_grad
        return sum(storages.values())

    assert kept_bytes(4) < 0.1 * kept_bytes(None)
