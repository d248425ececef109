"""Results on a GPU are those on the CPU."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from tangent_train.geometry import TangentGrid, equirect_shape, random_rotation
from tangent_train.geometry.icosphere import IcosphereElements
from tangent_train.rendering import (
    Blend,
    Interpolation,
    equirect_to_tangent,
    tangent_to_equirect,
    tangent_to_labels,
)
from tangent_train.rendering.mosaic import ScoreMosaic
from tangent_train.rendering.representations.icosphere import IcosphereViews
from tangent_train.rendering.representations.views import PinholeViews

pytestmark = pytest.mark.gpu

GRID = TangentGrid(1, 6)
SHAPE = equirect_shape(6)


def _random(*shape: int) -> torch.Tensor:
    return torch.from_numpy(np.random.default_rng(0).standard_normal(shape))


@pytest.mark.parametrize("interpolation", ["bilinear", "nearest"])
def test_tangent_images_equal_those_on_the_cpu(interpolation: Interpolation) -> None:
    panorama = _random(2, 3, *SHAPE)
    expected = equirect_to_tangent(panorama, GRID, [0, 7], interpolation)
    on_gpu = equirect_to_tangent(panorama.cuda(), GRID, [0, 7], interpolation)
    torch.testing.assert_close(on_gpu.cpu(), expected)


@pytest.mark.parametrize("interpolation", ["bilinear", "nearest"])
@pytest.mark.parametrize("elements", ["vertices", "faces"])
def test_signals_and_their_panoramas_equal_those_on_the_cpu(
    elements: IcosphereElements, interpolation: Interpolation
) -> None:
    panorama = _random(3, *SHAPE).float()
    views = IcosphereViews(6, elements, random_rotation(np.random.default_rng(0)))
    expected = views.render(panorama, interpolation)
    on_gpu = views.render(panorama.cuda(), interpolation)
    torch.testing.assert_close(on_gpu.cpu(), expected, rtol=1e-4, atol=1e-4)
    canvas, placed = (views.on_canvas(signal, SHAPE)[0] for signal in (expected, on_gpu))
    torch.testing.assert_close(placed.cpu(), canvas, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-7), (torch.float32, 1e-4)])
@pytest.mark.parametrize("blend", ["nearest", "feather"])
def test_panoramas_and_gradients_equal_those_on_the_cpu(
    blend: Blend, dtype: torch.dtype, tolerance: float
) -> None:
    images = _random(GRID.num_images, 2, GRID.dim, GRID.dim)
    weights = _random(2, *SHAPE)
    gradients = []
    for device, precision in (("cpu", torch.float64), ("cuda", dtype)):
        source = images.to(device, precision).requires_grad_()
        panorama = tangent_to_equirect(source, GRID, SHAPE, blend)
        (gradient,) = torch.autograd.grad((panorama * weights.to(source)).sum(), source)
        gradients += [panorama.detach().double().cpu(), gradient.double().cpu()]
    torch.testing.assert_close(gradients[2:], gradients[:2], rtol=tolerance, atol=tolerance)


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16, torch.float16])
@pytest.mark.parametrize("classes", [1, 13, 300])
@pytest.mark.parametrize("blend", ["nearest", "feather"])
def test_labels_of_each_precision_equal_those_on_the_cpu(
    blend: Blend, classes: int, dtype: torch.dtype
) -> None:
    scores = _random(GRID.num_images, classes, GRID.dim, GRID.dim).to(dtype)
    if blend == "nearest":  # feathered, NaN spreads to all neighbors
        scores[0], scores[1], scores[2, 0] = torch.nan, -torch.inf, torch.nan
    expected = tangent_to_labels(scores.double(), GRID, SHAPE, blend)
    on_gpu = tangent_to_labels(scores.cuda(), GRID, SHAPE, blend).cpu()
    least = 0.9999 if dtype == torch.float32 else 0.98  # what is rounded ties more often
    assert (on_gpu == expected).double().mean() > least


@pytest.mark.parametrize("averaged", [False, True])
@pytest.mark.parametrize("blend", ["nearest", "feather"])
def test_mosaics_equal_those_on_the_cpu_and_each_other(blend: Blend, averaged: bool) -> None:
    scores = _random(GRID.num_images, 13, GRID.dim, GRID.dim).float()
    found = []
    for device in ("cpu", "cuda", "cuda"):
        mosaic = ScoreMosaic(SHAPE, 13, blend, averaged=averaged, device=device)
        for part in (slice(0, 30), slice(30, None)):
            mosaic.add(scores[part].to(device), PinholeViews(GRID)[part])
        found.append(mosaic.labels().cpu())
    assert (found[1] == found[0]).double().mean() > 0.999
    assert torch.equal(found[1], found[2])
