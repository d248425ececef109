"""The icosahedral CNN against rotations of its mesh, and against rings sorted by angle."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from models import IcoCNN
from models.icocnn import GaugeConv, _Pool, _Unpool, atlas
from studies.rotation_error import icosahedral_rotations
from tangent_train.geometry.icosphere import icosphere, icosphere_directions


def _signals(level: int) -> Tensor:
    return torch.randn(2, 3, 1, 10 * 4**level + 2)


@pytest.mark.parametrize(("level", "widths"), [(2, (4, 3, 5)), (3, (2, 3))])
def test_rotations_of_the_icosahedron_rotate_the_scores(
    level: int, widths: tuple[int, ...]
) -> None:
    torch.manual_seed(0)
    network, signals = IcoCNN(3, 4, level, widths), _signals(level)
    tree = cKDTree(icosphere_directions(level))
    mirrored = icosphere(level).vertices * (1, -1, 1)
    for training in (True, False):
        with torch.no_grad():
            scores = network.train(training)(signals)
            assert scores.std(dim=-1).min() > 0.05, "constant scores would prove nothing"
            for rotation in icosahedral_rotations():
                _, moved = tree.query(tree.data @ rotation.T)
                torch.testing.assert_close(
                    network(signals[..., moved]), scores[..., moved], rtol=0, atol=1e-5
                )
    nearest = np.abs(mirrored[:, None] - icosphere(level).vertices).sum(axis=-1).argmin(axis=-1)
    with torch.no_grad():
        difference = network(signals[..., nearest]) - scores[..., nearest]
    assert difference.std() > 0.2 * scores.std(), "filters distinguish left from right"


@pytest.mark.parametrize("level", [1, 3])
def test_a_filter_is_applied_to_the_neighbors_in_cyclic_order(level: int) -> None:
    """Each orientation starts at another neighbor; a corner has the mean of all rotations."""
    torch.manual_seed(1)
    convolution = GaugeConv(1, 1, level, given=1).double()
    signal = torch.randn(1, 1, 1, 10 * 4**level + 2, dtype=torch.float64)
    with torch.no_grad():
        found = convolution(signal)[0, 0].numpy()
        weight, bias = (p.detach().numpy().ravel() for p in convolution.parameters())
    values, (vertices, faces) = signal.numpy().ravel(), icosphere(level)
    for vertex, direction in enumerate(vertices):
        around = np.setdiff1d(faces[(faces == vertex).any(axis=1)], vertex)
        east = np.cross(direction, vertices[around[0]])
        north = np.cross(east, direction)
        x, y = vertices[around] @ east, vertices[around] @ north / np.linalg.norm(direction)
        ring = values[around[np.argsort(np.arctan2(x, y))]]
        if len(ring) == 5:
            expected = np.full(
                6, weight[0] * values[vertex] + weight[1:].sum() * ring.mean() + bias
            )
            start = 0
        else:
            rotated = np.stack([np.roll(ring, -k) for k in range(6)])
            expected = weight[0] * values[vertex] + rotated @ weight[1:] + bias
            start = int(np.abs(expected - found[0, vertex]).argmin())
        np.testing.assert_allclose(found[:, vertex], np.roll(expected, -start), rtol=0, atol=1e-12)


@pytest.mark.parametrize("level", [1, 3])
def test_new_vertices_are_between_their_parents(level: int) -> None:
    directions = icosphere_directions(level)
    coarse = 10 * 4 ** (level - 1) + 2
    parents = atlas(level)["parents"][0].numpy() % coarse
    middle = directions[parents].sum(axis=0)
    _, nearest = cKDTree(directions).query(middle / np.linalg.norm(middle, axis=1, keepdims=True))
    assert np.array_equal(nearest, np.arange(coarse, len(directions)))


def test_pooling_and_unpooling_keep_directions() -> None:
    """Differences to the neighbors, as regular features, have the direction of those beside."""
    signal = torch.tensor(icosphere_directions(4) @ [0.6, 0.0, 0.8], dtype=torch.float32)
    found = {}
    for level in (3, 4):
        differences = GaugeConv(1, 1, level, given=1)
        with torch.no_grad():
            differences.weight.zero_()[..., :2] += torch.tensor([-1.0, 1.0])
            differences.bias.zero_()
            found[level] = differences(signal[: 10 * 4**level + 2].expand(1, 1, 1, -1))
    for expected, result in (
        (found[3], _Pool(4, "pooled")(found[4])),
        (found[4], _Unpool(4, "parents")(found[3])),
    ):
        pair = torch.stack([expected.ravel(), result.ravel()])
        assert torch.corrcoef(pair)[0, 1] > 0.98


def test_every_parameter_learns() -> None:
    network = IcoCNN(3, 5, 2, (2, 3, 4))
    network(_signals(2)).square().sum().backward()
    assert all(p.grad is not None and p.grad.abs().sum() > 0 for p in network.parameters())
    names = {name.rpartition(".")[2] for name in network.state_dict()}
    assert names == {"weight", "bias", "running_mean", "running_var", "num_batches_tracked"}
