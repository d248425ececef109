from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.special import sph_harm_y
from torch import Tensor

from tangent_train.checkpoints.loaded import load_network
from tangent_train.cli.run import build
from tangent_train.geometry import equirect_directions
from tests.running import composed_settings
from tests.tasks.small_networks import save_checkpoint

torch_harmonics = pytest.importorskip("torch_harmonics")

from models.harmonic_network import use_pixel_rows  # noqa: E402
from models.zonal import ZonalClassifier, ZonalConvolution  # noqa: E402


def network_of(name: str, level: int) -> Any:
    settings = (f"network={name}", f"level={level}", "data.inputs=[rgb,depth]")
    return build(composed_settings("train", *settings))[1].network


@pytest.mark.parametrize(("degree", "order"), [(0, 0), (3, 2), (20, 7), (31, 0), (31, 31)])
def test_transforms_of_pixel_centers_are_exact(degree: int, order: int) -> None:
    """The nearest grid of torch-harmonics returns other coefficients."""
    coefficients = np.zeros((32, 32), dtype=complex)
    coefficients[degree, order] = 1
    signal, errors = panoramas(coefficients, Rotation.identity()), []
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


@pytest.mark.parametrize("name", ["spherical_unet", "spherical_segformer", "sfno"])
def test_networks_of_torch_harmonics_commute_with_rotations_about_the_vertical(name: str) -> None:
    torch.manual_seed(0)
    network = network_of(name, 4).eval()
    images = torch.randn(1, 4, 32, 64)
    scores = network(images)
    assert scores.shape == (1, 13, 32, 64)
    scores.square().mean().backward()
    assert all(p.grad is not None for p in network.parameters())
    # Whole columns at the coarsest resolution.
    rotated = network(images.roll(16, -1)).roll(-16, -1)
    spread = scores.std()
    torch.testing.assert_close(rotated / spread, scores / spread, rtol=0, atol=1e-3)


def test_a_checkpoint_is_read_without_trust_and_works_in_mixed_precision(tmp_path: Path) -> None:
    save_checkpoint(tmp_path / "net.ckpt", "network=sfno", "level=3")
    network: Any = load_network(tmp_path / "net.ckpt").network
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert network(torch.zeros(1, 4, 16, 32)).shape == (1, 13, 16, 32)


def functions_at(
    directions: NDArray[np.float64], coefficients: NDArray[np.complex128]
) -> NDArray[np.float64]:
    """Values of real functions at directions ``(h, w, 3)``, from coefficients ``(…, l, m)``."""
    x, y, z = np.moveaxis(directions, -1, 0)
    angles = np.arccos(z.clip(-1, 1)), np.arctan2(y, x)
    degrees, orders = np.nonzero(coefficients.reshape(-1, *coefficients.shape[-2:]).any(axis=0))
    basis = sph_harm_y(degrees[:, None, None], orders[:, None, None], *angles)
    return np.einsum("...k,khw->...hw", coefficients[..., degrees, orders], basis).real


def panoramas(coefficients: NDArray[np.complex128], rotation: Rotation) -> Tensor:
    """Rotated functions as images ``(…, 64, 128)``, see `functions_at`."""
    directions = equirect_directions((64, 128)) @ rotation.as_matrix()
    return torch.tensor(functions_at(directions, coefficients)).float()


def test_zonal_convolution_is_the_integral_over_the_sphere() -> None:
    """(f * h)(x) = 2π ∫ h(x·y) f(y) dy, with Gauss–Legendre quadrature in float64."""
    rng = np.random.default_rng(0)
    coefficients = rng.normal(size=(2, 6, 6)) + 1j * rng.normal(size=(2, 6, 6))
    convolution = ZonalConvolution(2, 3, (64, 128), anchors=4, rows=64)
    filters = convolution.weight.detach().double().numpy()
    spectrum = np.apply_along_axis(
        lambda h: np.interp(np.linspace(0, 3, 32), np.arange(4), h), -1, filters
    )
    nodes, weights = np.polynomial.legendre.leggauss(40)
    z, longitudes = np.meshgrid(nodes, np.arange(80) * np.pi / 40, indexing="ij")
    points = np.stack([np.cos(longitudes), np.sin(longitudes), z], axis=-1)
    points[..., :2] *= np.sqrt(1 - z**2)[..., None]
    signal = functions_at(points, coefficients)
    results = convolution(panoramas(coefficients, Rotation.identity())[None])[0]
    places = [(0, 0), (13, 40), (32, 63), (63, 5)]
    for row, column in places:
        direction = equirect_directions((64, 128))[row, 2 * column]
        scaled = spectrum * np.sqrt((2 * np.arange(32) + 1) / (4 * np.pi))
        kernels = np.polynomial.legendre.legval(points @ direction, np.moveaxis(scaled, -1, 0))
        integral = np.einsum("dcij,cij,i->d", kernels, signal, weights) * np.pi / 40
        torch.testing.assert_close(
            results[:, row, column].double(), torch.tensor(2 * np.pi * integral), rtol=0, atol=1e-5
        )


def test_scores_of_the_zonal_classifier_do_not_change_under_rotation() -> None:
    """Inputs are band-limited; what remains is aliasing of the nonlinearity."""
    torch.manual_seed(0)
    network = ZonalClassifier(2, 40, 5)
    assert sum(p.numel() for p in network.parameters()) == 487_592
    rng = np.random.default_rng(0)
    coefficients = rng.normal(size=(4, 2, 4, 4)) + 1j * rng.normal(size=(4, 2, 4, 4))
    rotations = Rotation.random(2, random_state=1)
    upright, *rotated = (
        panoramas(coefficients, r)[:, None] for r in (Rotation.identity(), *rotations)
    )
    with torch.no_grad():
        network.train()(upright)
        scores, *others = (network.eval()(images) for images in (upright, *rotated))
    spread = (scores - scores.mean(dim=0)).norm()
    assert spread > 1
    for other in others:
        assert (other - scores).norm() / spread < 1e-3
    network.zero_grad()
    with torch.autocast("cpu", dtype=torch.bfloat16):
        mixed = network(upright)
    assert (mixed - scores).norm() / spread < 0.05
    network(upright).square().sum().backward()
    assert all(p.grad is not None and p.grad.isfinite().all() for p in network.parameters())
