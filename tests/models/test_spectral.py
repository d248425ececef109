from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.special import sph_harm_y
from torch import Tensor

from tangent_train.checkpoints.trained import load_trained
from tangent_train.cli.run import build
from tangent_train.errors import SettingError
from tangent_train.geometry import equirect_directions
from tests.running import composed_settings
from tests.tasks.small_networks import save_checkpoint

torch_harmonics = pytest.importorskip("torch_harmonics")

from models.harmonic_network import HarmonicNetwork, use_pixel_rows  # noqa: E402

NETWORKS = {"spherical_unet": 444_045, "spherical_segformer": 393_677, "sfno": 591_936}
"""Parameters with four channels and 13 classes."""


def harmonic(degree: int, order: int, rows: int) -> Tensor:
    """Real part of a spherical harmonic at the pixel centers of a panorama, by SciPy."""
    x, y, z = np.moveaxis(equirect_directions((rows, 2 * rows)), -1, 0)
    values = sph_harm_y(degree, order, np.arccos(z), np.arctan2(y, x)).real
    return torch.tensor(values, dtype=torch.float32)


def network_of(name: str, level: int) -> Any:
    settings = (f"network={name}", f"level={level}", "data.inputs=[rgb,depth]")
    return build(composed_settings("train", *settings))[1].network


@pytest.mark.parametrize(("degree", "order"), [(0, 0), (3, 2), (20, 7), (31, 0), (31, 31)])
def test_transforms_of_pixel_centers_are_exact(degree: int, order: int) -> None:
    """The nearest grid of torch-harmonics returns other coefficients."""
    signal, errors = harmonic(degree, order, 64), []
    for exact in (False, True):
        forward = torch_harmonics.RealSHT(64, 128, 32, 32, grid="legendre-gauss")
        inverse = torch_harmonics.InverseRealSHT(64, 128, 32, 32, grid="legendre-gauss")
        if exact:
            use_pixel_rows(forward)
            use_pixel_rows(inverse)
        spectrum = forward(signal)
        expected = torch.zeros(32, 32)
        expected[degree, order] = 1 if order == 0 else 0.5
        errors.append((spectrum.abs() - expected).abs().max().item())
    assert errors[1] < 1e-5
    assert degree == 0 or errors[0] > 1e-3
    torch.testing.assert_close(inverse(spectrum), signal, rtol=0, atol=1e-5)


@pytest.mark.parametrize("name", NETWORKS)
def test_networks_of_torch_harmonics_commute_with_rotations_about_the_vertical(name: str) -> None:
    torch.manual_seed(0)
    network = network_of(name, 5)
    assert sum(p.numel() for p in network.parameters()) == NETWORKS[name]
    network.eval()
    images = torch.randn(1, 4, 64, 128)
    scores = network(images)
    assert scores.shape == (1, 13, 64, 128)
    scores.square().mean().backward()
    assert all(p.grad is not None for p in network.parameters())
    # Whole columns at the coarsest resolution.
    rotated = network(images.roll(32, -1)).roll(-32, -1)
    spread = scores.std()
    torch.testing.assert_close(rotated / spread, scores / spread, rtol=0, atol=1e-3)


def test_a_checkpoint_is_read_without_trust(tmp_path: Path) -> None:
    save_checkpoint(tmp_path / "net.ckpt", "network=sfno", "level=3")
    network: Any = load_trained(tmp_path / "net.ckpt").network
    assert network(torch.zeros(1, 4, 16, 32)).shape == (1, 13, 16, 32)


def test_images_of_another_size_are_refused() -> None:
    network = network_of("sfno", 3)
    message = r"found images of 64 × 32 .*expected whole .* 32 × 16 .*representation=erp"
    with pytest.raises(SettingError, match=message):
        network(torch.zeros(1, 4, 32, 64))


def test_a_missing_package_is_named_with_its_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "torch_harmonics.examples", None)
    with pytest.raises(SettingError, match=r"network=SphericalUNet: .*'\.\[spectral\]'"):
        HarmonicNetwork("SphericalUNet", 3, 5, 3, {})
