"""A network with context: what it was before training, and who sees whom after it."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional

from models import AuxiliaryHead, SphereContext
from models.stages import token_directions
from tangent_train.geometry import TangentGrid, random_rotation
from tests.models.sphere_networks import (
    ATTENTION,
    STAGE,
    awake,
    small_context,
    small_unet,
    sphere_rays,
    tangent_rays,
)

GPU = pytest.mark.gpu
DEVICES = ["cpu", pytest.param("cuda", marks=GPU)]


@pytest.fixture(autouse=True)
def _weights_of_a_seed() -> None:
    torch.manual_seed(0)


@pytest.mark.parametrize("size", [(16, 16), (4, 20)])
def test_before_training_it_computes_what_the_network_computes(size: tuple[int, int]) -> None:
    network = small_unet()
    context = SphereContext(copy.deepcopy(network), STAGE, ATTENTION, in_channels=3)
    images = torch.randn(6, 3, *size)
    for module in (network.eval(), context.eval()):
        module.requires_grad_(False)
    expected = network(images)
    assert torch.equal(context(images), expected)
    assert torch.equal(context(images, sphere_rays(3, 2)), expected)
    torch.testing.assert_close(context(images, sphere_rays(3, 2), 4), expected)


class Averaging(nn.Module):
    """A mixer that adds the mean of all images' tokens, and what they look along."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.scale = nn.Parameter(torch.ones(channels))

    def forward(self, tokens: Tensor, directions: Tensor) -> Tensor:
        mean = tokens.mean(dim=(1, 3, 4), keepdim=True) + directions.sum(2, keepdim=True)
        return mean.expand_as(tokens) * self.scale[:, None, None]


def test_the_mixers_result_is_added_to_the_features() -> None:
    """The stage is the whole network here."""
    network = nn.Sequential(nn.Conv2d(3, 4, 3, padding=1))
    context = SphereContext(network, "0", Averaging, in_channels=3, tokens=2)
    images, rays = torch.randn(3, 3, 12, 10), sphere_rays(3)
    features = network[0](images)
    tokens = functional.adaptive_avg_pool2d(features, 2)[None]
    mixed = context.mixer(tokens, token_directions(rays, 2, 2))[0]
    expected = features + functional.interpolate(mixed, (12, 10), mode="bilinear")
    torch.testing.assert_close(context(images, rays), expected)
    torch.testing.assert_close(context(images, rays, 2), expected)


def test_an_image_alone_or_without_rays_has_no_context() -> None:
    context = small_context().eval()
    images, rays = torch.randn(5, 3, 16, 16), sphere_rays(5)
    with torch.no_grad():
        expected = context.network(images)
        assert torch.equal(context(images), expected)
        assert torch.equal(context(images, rays.reshape(5, 1, 3, 3)), expected)
        assert not torch.allclose(context(images, rays), expected, rtol=0, atol=1e-5)


@pytest.mark.parametrize("size", [(15, 15), (5, 3)])
def test_tokens_look_along_the_middle_of_their_pixels(size: tuple[int, int]) -> None:
    grid = TangentGrid(0, 4, 15, random_rotation(np.random.default_rng(0)))
    pixels = torch.tensor(grid.directions()).movedim(-1, 1)
    along = (pixels * torch.tensor(grid.centers_xyz)[..., None, None]).sum(1, keepdim=True)
    found = token_directions(tangent_rays(grid)[None], *size)
    middle = functional.normalize(functional.adaptive_avg_pool2d(pixels / along, size), dim=1)
    torch.testing.assert_close(found[0], middle, rtol=0, atol=1e-12)


def test_copies_are_independent_and_the_inner_network_is_unchanged() -> None:
    network, images, rays = small_unet().eval(), torch.randn(2, 3, 16, 16), sphere_rays(2)
    plain = network(images)
    context = small_context(network).eval()
    expected = context(images, rays)
    assert not torch.allclose(expected, plain, atol=1e-3)
    assert torch.equal(network(images), plain)
    with pytest.raises(RuntimeError, match="Sizes of tensors"):
        context(torch.zeros(2, 3, 6, 6), rays)
    assert torch.equal(network(images), plain), "nothing is left behind by an error"
    other = copy.deepcopy(context)
    awake(context)
    torch.testing.assert_close(other(images, rays), expected)


def _gradients(
    context: nn.Module, images: Tensor, rays: Tensor | None, size: int | None
) -> tuple[Any, dict[str, Tensor]]:
    """Scores, and gradients of a function of them that no two pixels have the same share in."""
    context.zero_grad()
    scores = context(images, rays, view_batch_size=size)
    named = scores if isinstance(scores, dict) else {"out": scores}
    generator = torch.Generator().manual_seed(0)
    loss: Any = 0
    for tensor in named.values():
        weight = torch.randn(tensor.shape, generator=generator, dtype=images.dtype)
        loss = loss + (tensor.square() * weight.to(tensor.device)).sum()
    loss.backward()
    found = {n: p.grad.clone() for n, p in context.named_parameters() if p.grad is not None}
    return scores, found


def test_chunks_are_even() -> None:
    """5 images in chunks of at most 4: not one alone, which batch normalization may refuse."""
    context = small_context(small_unet()).eval()
    sizes = []
    context.network.register_forward_pre_hook(lambda _, images: sizes.append(len(images[0])))
    context(torch.randn(5, 3, 16, 16), sphere_rays(5), view_batch_size=4)
    assert set(sizes) == {3, 2}


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


@pytest.mark.parametrize("device", DEVICES)
def test_a_chunk_drops_out_the_same_in_every_run(device: str) -> None:
    encoder = nn.Sequential(nn.Conv2d(3, 8, 1), nn.Dropout(0.5))
    network = nn.Sequential(encoder, nn.Conv2d(8, 4, 1))
    context = SphereContext(network, "0", ATTENTION, in_channels=3, tokens=2).double().train()
    awake(context.to(device).mixer)
    images = torch.randn(6, 3, 8, 8).double().to(device)
    rays = sphere_rays(6).double().to(device)
    dropped: list[Tensor] = []
    encoder[1].register_forward_hook(lambda _m, _i, result: dropped.append(result == 0))
    generator: Any = torch if device == "cpu" else torch.cuda
    torch.manual_seed(3)
    _, gradients = _gradients(context, images, rays, 3)
    after = generator.get_rng_state()
    # Two chunks: encoded, decoded, then both again for the gradient, the last one first.
    assert len(dropped) == 8
    assert not torch.equal(dropped[0], dropped[1]), "chunks draw differently"
    for chunk in dropped[:2]:
        assert sum(torch.equal(run, chunk) for run in dropped) == 4
    assert 0.3 < float(dropped[0].float().mean()) < 0.7
    torch.manual_seed(3)
    assert torch.equal(generator.get_rng_state(), after) == (device == "cuda")
    _, again = _gradients(context, images, rays, 3)
    tolerance = 0 if device == "cpu" else 1e-9  # a GPU adds in varying order
    torch.testing.assert_close(again, gradients, rtol=tolerance, atol=tolerance)
    assert torch.equal(generator.get_rng_state(), after)


@GPU
def test_scores_and_gradients_on_a_gpu_are_those_of_the_cpu() -> None:
    context = small_context().double().eval()
    images, rays = torch.randn(6, 3, 16, 16).double(), sphere_rays(3, 2).double()
    for size in (None, 4):
        expected = _gradients(context, images, rays, size)
        scores, found = _gradients(copy.deepcopy(context).cuda(), images.cuda(), rays.cuda(), size)
        torch.testing.assert_close((scores, found), expected, check_device=False)


@GPU
@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_half_precision_is_close_to_single(dtype: torch.dtype) -> None:
    context = small_context().cuda().eval()
    images, rays = torch.randn(4, 3, 16, 16).cuda(), sphere_rays(4).cuda()
    with torch.no_grad():
        expected = context(images, rays)
        with torch.autocast("cuda", dtype):
            for found in (context(images, rays), context(images, rays, 3)):
                torch.testing.assert_close(found.float(), expected, rtol=0.1, atol=0.1)


def test_only_one_chunk_is_kept_for_the_gradient() -> None:
    context, images, rays = small_context().train(), torch.randn(16, 3, 32, 32), sphere_rays(16)

    def kept_bytes(size: int | None) -> int:
        """Return the bytes of tensors that the graph holds between forward and backward pass."""
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
