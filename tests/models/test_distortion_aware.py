"""Convolutions that are sampled on the sphere, against formulas evaluated pixel by pixel."""

from __future__ import annotations

import math
from itertools import product
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from models import UNet, make_distortion_aware
from models.distortion_aware import DistortionAwareConv2d, make_ordinary
from tangent_train.errors import SettingError


def _interpolated(image: NDArray[np.float64], row: float, column: float) -> NDArray[np.float64]:
    """Bilinear, around the seam and across the poles, where the row is that of the other side."""
    height, width = image.shape[1:]
    top, left = math.floor(row), math.floor(column)
    total = np.zeros(len(image))
    for i, j in product((top, top + 1), (left, left + 1)):
        weight = (1 - abs(row - i)) * (1 - abs(column - j))
        inside = -1 - i if i < 0 else 2 * height - 1 - i if i >= height else i
        total += weight * image[:, inside, (j + (i != inside) * width // 2) % width]
    return total


def _reference(
    image: NDArray[np.float64], conv: nn.Conv2d, padding: tuple[int, int], row: int, column: int
) -> NDArray[np.float64]:
    """One output pixel by the inverse gnomonic projection (Coors et al. 2018)."""
    height, width = image.shape[1:]
    weight = conv.weight.detach().numpy()
    (kh, kw), (sy, sx), (dy, dx) = conv.kernel_size, conv.stride, conv.dilation
    v = row * sy - padding[0] + dy * (kh - 1) / 2
    u = column * sx - padding[1] + dx * (kw - 1) / 2
    phi, theta = math.pi / 2 - (v + 0.5) / height * math.pi, (u + 0.5) / width * 2 * math.pi
    pitch = math.tan(2 * math.pi / width)
    taps = np.zeros((len(image), kh, kw))
    for i, j in product(range(kh), range(kw)):
        x, y = (j - (kw - 1) / 2) * dx * pitch, ((kh - 1) / 2 - i) * dy * pitch
        rho = math.hypot(x, y)
        nu = math.atan(rho)
        share = y / rho if rho else 0.0
        sine = math.cos(nu) * math.sin(phi) + share * math.sin(nu) * math.cos(phi)
        lat = math.asin(min(max(sine, -1.0), 1.0))
        across = rho * math.cos(phi) * math.cos(nu) - y * math.sin(phi) * math.sin(nu)
        lon = theta + (math.atan2(x * math.sin(nu), across) if rho else 0.0)
        at = (math.pi / 2 - lat) / math.pi * height - 0.5, lon / (2 * math.pi) * width - 0.5
        taps[:, i, j] = _interpolated(image, *at)
    groups = np.split(taps, conv.groups)
    filters = np.split(weight, conv.groups)
    return np.concatenate([np.tensordot(w, t, 3) for w, t in zip(filters, groups, strict=True)])


@pytest.mark.filterwarnings("ignore:Using padding='same' with even kernel lengths")
@pytest.mark.parametrize(
    ("settings", "padding"),
    [
        ({"kernel_size": 3, "padding": 1}, (1, 1)),
        ({"kernel_size": (3, 5), "padding": "same", "dilation": (2, 1)}, (2, 2)),
        ({"kernel_size": 4, "padding": "same", "groups": 2}, (1, 1)),
        ({"kernel_size": 4, "padding": 1, "stride": 2, "bias": False}, (1, 1)),
        ({"kernel_size": (2, 4), "stride": (2, 4), "groups": 4}, (0, 0)),  # patches
        ({"kernel_size": 3, "padding": 6, "dilation": 6, "padding_mode": "circular"}, (6, 6)),
    ],
)
def test_every_pixel_is_that_of_the_formulas(
    settings: dict[str, Any], padding: tuple[int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """At the seam, at the poles, and with the rows in several parts."""
    monkeypatch.setattr("models.distortion_aware._SAMPLES", 3000)
    torch.manual_seed(0)
    conv = nn.Conv2d(4, 8, **settings, dtype=torch.float64)
    images = torch.randn(2, 4, 12, 24, dtype=torch.float64)
    found = make_distortion_aware(conv)(images)
    assert found.shape == conv(images).shape
    bias = torch.zeros(8) if conv.bias is None else conv.bias
    pixels = list(product(range(found.shape[-2]), range(0, found.shape[-1], 3)))
    for (row, column), n in product(pixels, (0, 1)):
        expected = _reference(images[n].numpy(), conv, padding, row, column)
        np.testing.assert_allclose(
            (found[n, :, row, column] - bias).detach().numpy(), expected, atol=1e-9
        )


def test_it_approaches_the_ordinary_convolution_at_the_equator() -> None:
    """With an error of order 3 in the angle of a pixel; near the poles it stays different."""
    torch.manual_seed(0)
    conv = nn.Conv2d(1, 4, 3, padding=1, bias=False, dtype=torch.float64)
    with torch.no_grad():
        conv.weight -= conv.weight.mean(dim=(2, 3), keepdim=True)
    errors = []
    for height in (32, 64, 128):
        v, u = torch.meshgrid(torch.arange(height), torch.arange(2 * height), indexing="ij")
        lat, lon = math.pi / 2 - (v + 0.5) / height * math.pi, (u + 0.5) / height * math.pi
        image = (lat.cos() * lon.cos() + lat.sin() * (2 * lat).cos()).double()[None, None]
        change = (make_distortion_aware(conv)(image) - conv(image)).abs().amax(dim=(0, 1))
        errors.append([change[k, 2:-2].amax().item() for k in (height // 2, 2)])
    (fine, polar), (coarse, _) = errors[2], errors[1]
    assert coarse / fine == pytest.approx(8, rel=0.1)
    assert polar > 100 * fine


def test_gradients_are_those_of_finite_differences(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("models.distortion_aware._SAMPLES", 500)
    conv = make_distortion_aware(nn.Conv2d(2, 2, 3, padding=1, groups=2, dtype=torch.float64))
    images = torch.randn(1, 2, 4, 8, dtype=torch.float64, requires_grad=True)
    parameters = tuple(conv.parameters())

    def call(images: Tensor, weight: Tensor, bias: Tensor) -> Any:
        return torch.func.functional_call(conv, {"weight": weight, "bias": bias}, images)

    assert torch.autograd.gradcheck(call, (images, *parameters), fast_mode=True)


def test_a_network_keeps_its_tensors_and_their_names() -> None:
    network = UNet(3, 4, (4, 6, 8)).eval()
    converted = make_distortion_aware(network)
    images = torch.randn(2, 3, 16, 32)
    tensors = converted.state_dict(keep_vars=True)
    assert {n: id(t) for n, t in tensors.items()} == {
        n: id(t) for n, t in network.state_dict(keep_vars=True).items()
    }
    ordinary = [m for m in network.modules() if type(m) is DistortionAwareConv2d]
    assert not ordinary, "the network is not changed"
    assert (converted(images) - network(images)).abs().max() > 1e-3
    assert make_ordinary(network) is network
    for same in (make_ordinary(converted), make_ordinary(make_distortion_aware(converted))):
        torch.testing.assert_close(same(images), network(images), rtol=0, atol=0)


def test_a_network_without_such_convolutions_is_refused() -> None:
    class Standardized(nn.Conv2d):
        pass

    with pytest.raises(SettingError, match=r"Linear with none; .* from torch instead"):
        make_distortion_aware(nn.Linear(3, 3))
    with pytest.raises(SettingError, match="Sequential with 1, a Standardized; expected"):
        make_distortion_aware(nn.Sequential(nn.Conv2d(3, 3, 3), Standardized(3, 3, 3)))
    network = make_distortion_aware(nn.Conv2d(3, 3, 3))
    with pytest.raises(SettingError, match=r"32 × 32 .* twice as wide .*=erp_distortion_aware"):
        network(torch.zeros(1, 3, 32, 32))
    strided = make_distortion_aware(nn.Sequential(*[nn.Conv2d(3, 3, 3, 2, 1) for _ in range(2)]))
    with pytest.raises(SettingError, match=r"features of 13 × 7 .* a multiple of the network's"):
        strided(torch.zeros(1, 3, 13, 26))


@pytest.mark.parametrize("shape", [(1, 2), (2, 4), (3, 6)])
def test_taps_of_small_features_are_on_the_sphere(shape: tuple[int, int]) -> None:
    ordinary = nn.Conv2d(1, 1, 3, padding=1, bias=False)
    features = make_distortion_aware(ordinary)(torch.ones(1, 1, *shape))
    torch.testing.assert_close(features, ordinary.weight.sum().expand(1, 1, *shape))
