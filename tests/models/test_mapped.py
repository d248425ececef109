"""Tables and the convolutions on them, against dense products and closed forms."""

from __future__ import annotations

import copy
import pickle
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy import sparse
from torch import Tensor, nn

from models.mapped import MappedConv, Table, mesh_operators
from tangent_train.geometry import icosphere, vertex_resolution
from tangent_train.geometry.icosphere import icosphere_directions

CL = torch.channels_last


def _some_table(taps: int = 3, outputs: int = 7, inputs: int = 5) -> Table:
    """A table of random operators, with a row and a column that are empty."""
    rng = np.random.default_rng(0)
    dense = rng.normal(size=(taps, outputs, inputs)) * (rng.random((taps, outputs, inputs)) < 0.5)
    dense[1, 2], dense[:, :, 3] = 0, 0
    return Table.of_operators([sparse.csr_array(operator) for operator in dense])


def _dense(convolution: MappedConv, x: Tensor) -> Tensor:
    table = convolution.table
    shape = table.outputs, table.taps, table.inputs
    matrix = torch.tensor(table.matrix.toarray().reshape(shape), dtype=x.dtype)
    y = torch.einsum("vki,bci,ock->bov", matrix, x[:, :, 0], convolution.weight)
    return (y if convolution.bias is None else y + convolution.bias[:, None])[:, :, None]


@pytest.mark.parametrize("bias", [True, False])
def test_convolution_equals_the_dense_product_and_its_gradients(
    bias: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    convolution = MappedConv(4, 6, _some_table(), bias).double()
    x = torch.randn(2, 4, 1, 5, dtype=torch.double, requires_grad=True)
    torch.testing.assert_close(convolution(x), _dense(convolution, x))
    with monkeypatch.context() as exporting:
        exporting.setattr("torch.compiler.is_exporting", lambda: True)
        torch.testing.assert_close(convolution(x), _dense(convolution, x), atol=1e-6, rtol=1e-6)
    assert convolution(x).is_contiguous(memory_format=CL)
    assert torch.autograd.gradcheck(convolution, (x,))
    torch.testing.assert_close(convolution(x.to(memory_format=CL)), _dense(convolution, x))


def test_low_precision_collects_in_float32_and_returns_the_precision_of_its_input() -> None:
    convolution = MappedConv(8, 8, _some_table())
    x = torch.randn(2, 8, 1, 5)
    with torch.autocast("cpu", torch.bfloat16):
        automatic = convolution(x)
    half = convolution.half()(x.half())
    assert (automatic.dtype, half.dtype) == (torch.bfloat16, torch.half)
    expected = _dense(convolution.float(), x)
    torch.testing.assert_close(automatic.float(), expected, atol=0.03, rtol=0.03)
    torch.testing.assert_close(half.float(), expected, atol=0.01, rtol=0.01)


def _two_layers() -> nn.Sequential:
    table = mesh_operators(1)
    return nn.Sequential(MappedConv(2, 3, table), MappedConv(3, 2, table))


def test_weights_start_as_those_of_convolutions_of_torch() -> None:
    torch.manual_seed(0)
    ours, of_torch = MappedConv(6, 500, _some_table(taps=9)), nn.Conv1d(6, 500, 9)
    for own, other in zip(ours.parameters(), of_torch.parameters(), strict=True):
        torch.testing.assert_close(own.abs().max(), other.abs().max(), rtol=0.02, atol=0)


def test_tables_are_shared_and_in_no_checkpoint() -> None:
    network = _two_layers()
    assert set(network.state_dict()) == {"0.weight", "0.bias", "1.weight", "1.bias"}
    assert not list(network.buffers())
    copied: Any = copy.deepcopy(network)
    assert copied[0].table is copied[1].table is mesh_operators(1)
    x = torch.randn(1, 2, 1, 42)
    network(x)
    torch.testing.assert_close(pickle.loads(pickle.dumps(network))(x), network(x))


def test_entries_are_added_up_and_broadcast() -> None:
    table = Table.of_entries(np.array([[[0, 2, 2]], [[1, 0, 1]]]), np.array([0.5, 0.25, 0.25]), 3)
    assert (table.outputs, table.taps, table.inputs) == (2, 1, 3)
    assert table.matrix.toarray().tolist() == [[0.5, 0, 0.5], [0.25, 0.75, 0]]
    assert table.matrix.nnz == 4


def _harmonics(points: NDArray[np.float64]) -> dict[str, tuple[int, NDArray[np.float64]]]:
    """Eigenvalue l(l + 1), and value, ∂EW and ∂NS of spherical harmonics of degree l."""
    x, y, z = points.T
    lon, cos, sin = np.arctan2(y, x), np.hypot(x, y), z
    return {
        "z": (2, np.stack([z, 0 * z, cos])),
        "xy": (6, np.stack([x * y, cos * np.cos(2 * lon), -cos * sin * np.sin(2 * lon)])),
        "x² − y²": (
            6,
            np.stack([x**2 - y**2, -2 * cos * np.sin(2 * lon), -2 * cos * sin * np.cos(2 * lon)]),
        ),
        "(3z² − 1) / 2": (6, np.stack([1.5 * z**2 - 0.5, 0 * z, 3 * sin * cos])),
    }


@pytest.mark.parametrize("name", ["z", "xy", "x² − y²", "(3z² − 1) / 2"])
def test_mesh_operators_converge_to_the_derivatives_of_spherical_harmonics(name: str) -> None:
    """Halving the edges halves the errors of L at least; those of ∂EW and ∂NS fall faster."""
    errors = []
    for level in (3, 4, 5):
        points, faces = icosphere_directions(level), icosphere(level).faces
        a, b, c = np.moveaxis(points[faces], 1, 0)
        of_faces = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
        areas = np.bincount(faces.ravel(), np.repeat(of_faces, 3)) / 3
        degrees, (value, east, north) = _harmonics(points)[name]
        same, laplacian, *derivatives = (mesh_operators(level).matrix @ value).reshape(-1, 4).T
        np.testing.assert_array_equal(same, value)
        per_radian = np.stack(derivatives) / vertex_resolution(level)
        found = np.stack([12**0.5 * laplacian / areas, *per_radian])
        wrong = found - np.stack([-degrees * value, east, north])
        errors.append(np.sqrt((areas * wrong**2).sum(axis=1) / areas.sum()))
    coarse, middle, fine = errors
    assert (fine < (0.011, 0.0015, 0.0015)).all()
    for before, after in ((coarse, middle), (middle, fine)):
        assert (after <= before * np.array([0.5, 0.3, 0.3]) + 1e-12).all()


def test_no_mesh_operator_outweighs_the_others_at_any_level() -> None:
    """For white noise, they have 1.1, 0.6 and 0.6 times the size of the signal."""
    for level in range(2, 6):
        rows = mesh_operators(level).matrix
        sizes = np.sqrt(rows.power(2).sum(axis=1).reshape(-1, 4).mean(axis=0))
        np.testing.assert_allclose(sizes, (1, 1.08, 0.6, 0.6), rtol=0.2, err_msg=str(level))


@pytest.mark.parametrize("level", [0, 3])
def test_derivatives_of_a_constant_are_zero_and_poles_have_no_direction(level: int) -> None:
    sums = mesh_operators(level).matrix.sum(axis=1).reshape(-1, 4)
    np.testing.assert_allclose(sums, np.tile([1, 0, 0, 0], (len(sums), 1)), atol=1e-12)
    x, y, z = icosphere_directions(level).T
    poles = np.flatnonzero(np.abs(z) == 1)
    assert len(poles) == 2
    for function in (x, y, x * y):
        rows = (mesh_operators(level).matrix @ function).reshape(-1, 4)[poles]
        np.testing.assert_allclose(rows, 0, atol=1e-12)
