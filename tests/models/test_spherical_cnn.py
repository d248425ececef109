from __future__ import annotations

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.special import sph_harm_y
from torch import Tensor

from models.spherical_cnn import RingCorrelation, SphericalCNN
from tangent_train.geometry import equirect_directions

Points = NDArray[np.float64]


def random_function(degrees: int, channels: tuple[int, ...], seed: int) -> NDArray[np.complex128]:
    """Coefficients ``(…, l, m)`` of functions on the sphere, for `values_at`."""
    rng = np.random.default_rng(seed)
    shape = (*channels, degrees, degrees)
    return rng.normal(size=shape) + 1j * rng.normal(size=shape)


def values_at(coefficients: NDArray[np.complex128], points: Points) -> Points:
    """Real values ``(…, points)`` at directions ``(points, 3)``, by SciPy's harmonics."""
    x, y, z = points.T
    degree, order = np.tril_indices(coefficients.shape[-1])
    basis = sph_harm_y(degree[:, None], order[:, None], np.arccos(z.clip(-1, 1)), np.arctan2(y, x))
    return (coefficients[..., degree, order] @ basis).real


def panoramas(coefficients: NDArray[np.complex128], rows: int, rotation: Rotation) -> Tensor:
    """Images ``(…, H, 2H)`` of rotated functions."""
    points = equirect_directions((rows, 2 * rows)).reshape(-1, 3) @ rotation.as_matrix()
    values = values_at(coefficients, points).reshape(*coefficients.shape[:-2], rows, 2 * rows)
    return torch.tensor(values).float()


def grid(rows: int, columns: int) -> Rotation:
    """Rotations of the grid of ``(rows, columns, columns)`` angles β, γ, α, flattened."""
    beta, gamma, alpha = np.meshgrid(
        (np.arange(rows) + 0.5) * np.pi / rows,
        *[np.arange(columns) * 2 * np.pi / columns] * 2,
        indexing="ij",
    )
    return Rotation.from_euler("ZYZ", np.stack([alpha, beta, gamma], axis=-1).reshape(-1, 3))


def ring_points(rings_deg: list[float], count: int) -> Rotation:
    """The rotations of the weights of a filter, ``(rings · count)``."""
    alpha, beta = np.meshgrid(np.arange(count) * 360 / count, rings_deg)
    angles = np.stack([alpha, beta, np.zeros_like(alpha)], axis=-1)
    return Rotation.from_euler("ZYZ", angles.reshape(-1, 3), degrees=True)


def weights_of(layer: RingCorrelation) -> Points:
    """Weights ``(C, C', rings · count)`` in the order of `ring_points`."""
    weight: Points = layer.weight.detach().double().movedim(1, 2).flatten(2).numpy()
    return weight


@pytest.mark.parametrize("rings_deg", [[90.0], [10.0, 35.0]])
def test_correlation_of_the_sphere_samples_the_function_at_the_rotated_points(
    rings_deg: list[float],
) -> None:
    """(f ⋆ ψ)(R) = Σ ψ_p f(R x_p), with f from SciPy's harmonics, at all rotations of the grid."""
    torch.manual_seed(0)
    layer = RingCorrelation(
        2, 3, rows=16, bandwidth=5, rings_deg=rings_deg, points=16, turns=1, result_rows=10
    )
    function = random_function(5, (2,), 0)
    # The grid starts at the first column of the image.
    first_column = Rotation.from_euler("Z", -180 + 180 / 32, degrees=True)
    result = layer(panoramas(function, 16, Rotation.identity())[None].unsqueeze(-2))[0]
    places = ring_points(rings_deg, 16).apply([0, 0, 1])
    expected = np.zeros((3, 10 * 10 * 10))
    for place, weights in zip(places, np.moveaxis(weights_of(layer), -1, 0), strict=True):
        points = (first_column * grid(10, 10)).apply(place)
        expected += weights.T @ values_at(function, points)
    found = result.detach().double().flatten(1)
    torch.testing.assert_close(found, torch.tensor(expected), rtol=0, atol=2e-5)


@pytest.mark.parametrize("rings_deg", [[90.0], [10.0, 35.0]])
def test_correlation_of_rotations_samples_the_function_at_the_rotated_points(
    rings_deg: list[float],
) -> None:
    """(f ⋆ ψ)(R) = Σ ψ_p f(R g_p), for f(R) = Σ_i h_i(R x_i) with functions h_i on the sphere."""
    torch.manual_seed(0)
    layer = RingCorrelation(
        2, 3, rows=12, bandwidth=4, rings_deg=rings_deg, points=10, turns=12, result_rows=11
    )
    function = random_function(4, (3, 2), 1)
    places = Rotation.random(3, random_state=2).apply([0, 0, 1])

    def signal(rotations: Rotation) -> Points:
        parts = (values_at(h, rotations.apply(x)) for h, x in zip(function, places, strict=True))
        return np.sum(list(parts), axis=0)

    values = torch.tensor(signal(grid(12, 12))).float().view(1, 2, 12, 12, 12)
    expected = np.zeros((3, 11 * 11 * 11))
    points = ring_points(rings_deg, 10)
    for point, weights in zip(points, np.moveaxis(weights_of(layer), -1, 0), strict=True):
        expected += weights.T @ signal(grid(11, 11) * point)
    found = layer(values)[0].detach().double().flatten(1)
    torch.testing.assert_close(found, torch.tensor(expected), rtol=0, atol=2e-5)


def test_higher_degrees_are_left_out() -> None:
    """A degree between the bandwidth and half of the rows does not alias."""
    layer = RingCorrelation(
        1, 1, rows=16, bandwidth=4, rings_deg=[90.0], points=8, turns=1, result_rows=8
    )
    function = random_function(8, (1,), 0)
    function[:, :4] = 0
    images = panoramas(function, 16, Rotation.identity())
    assert layer(images[None].unsqueeze(-2)).abs().max() < 1e-5


def rotation_error(oversampling: int) -> float:
    """Largest change of scores under three rotations, relative to their norm."""
    torch.manual_seed(0)
    network = SphericalCNN(2, 5, 3, [8, 16], [8, 6], oversampling=oversampling)
    function = random_function(3, (4, 2), 0)
    rotations = Rotation.identity(), *Rotation.random(3, random_state=1)
    upright, *rotated = (panoramas(function, 16, r)[:, None] for r in rotations)
    with torch.no_grad():
        network.train()(upright)
        scores, *others = (network.eval()(images) for images in (upright, *rotated))
    assert (scores - scores.mean(dim=0)).norm() > 0.05 * scores.norm()
    return max(((other - scores).norm() / scores.norm()).item() for other in others)


def test_scores_do_not_change_under_rotation() -> None:
    """Inputs are band-limited; what remains is aliasing of ReLU, which a finer grid reduces."""
    errors = [rotation_error(1), rotation_error(2)]
    assert errors[0] < 3e-3
    assert errors[1] < min(1e-3, errors[0] / 3)


def test_gradients_and_mixed_precision() -> None:
    torch.manual_seed(0)
    network = SphericalCNN(2, 5, 3, [8, 16], [8, 6])
    images = torch.randn(4, 2, 2, 16, 32)
    scores = network(images)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        mixed = network(images)
    torch.testing.assert_close(mixed.float(), scores, rtol=0, atol=0.02)
    scores.square().sum().backward()
    assert all(p.grad is not None and p.grad.abs().max() > 0 for p in network.parameters())


def test_the_number_of_parameters_is_that_of_the_released_code() -> None:
    """Of its smaller network at level 4, without biases before batch normalization."""
    network = SphericalCNN(6, 55, 4, [100, 100], [16, 10])
    rings = 6 * 100 * 32 + 100 * 100 * 32
    assert sum(p.numel() for p in network.parameters()) == rings + 2 * 200 + 101 * 55
