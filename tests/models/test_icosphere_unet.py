"""The UNet on nested icospheres."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from models import (
    IcosphereUNet,
    MappedConv,
    Table,
    face_neighbors,
    gnomonic_points,
    hexagonal_rings,
    mesh_operators,
)
from models.icosphere_unet import Pooling
from models.mapped import vertex_means, vertex_parents
from models.unet import Residual
from tangent_train.geometry import icosphere, rotation_about
from tangent_train.geometry.icosphere import icosphere_directions
from tests.tasks.small_networks import with_statistics


@pytest.mark.parametrize(
    ("channels", "classes", "width", "count"), [(4, 15, 16, 1_301_167), (16, 3, 8, 328_339)]
)
def test_parameters_of_the_published_networks(
    channels: int, classes: int, width: int, count: int
) -> None:
    """The climate network of the article, and the width of the released script."""
    widths = [width * times for times in (1, 2, 4, 8, 16, 16)]
    network = IcosphereUNet(channels, classes, 5, mesh_operators, widths)
    assert sum(p.numel() for p in network.parameters()) == count


def test_parameters_of_the_published_classifier_with_hexagonal_filters() -> None:
    """HexRUNet-C has 74,730 (Zhang et al. 2019, supplement, section 2.1)."""
    layers = [
        MappedConv(1, 16, hexagonal_rings(4)),
        Residual(16, 64, partial(MappedConv, table=hexagonal_rings(3))),
        Residual(64, 256, partial(MappedConv, table=hexagonal_rings(2))),
        torch.nn.Linear(256, 10),
    ]
    assert sum(p.numel() for layer in layers for p in layer.parameters()) == 74_730


@pytest.mark.parametrize(
    ("table", "settings"),
    [
        (mesh_operators, {}),
        (mesh_operators, {"unpooling": "ones"}),
        (mesh_operators, {"pooling": "mean", "unpooling": "mean"}),
        (hexagonal_rings, {"pooling": "mean", "unpooling": "mean", "normalized_ups": True}),
        (face_neighbors, {"pooling": "max", "unpooling": "repeat"}),
        (gnomonic_points, {}),
    ],
)
def test_scores_turn_with_the_icosphere_and_every_parameter_learns(
    table: Callable[[int], Table], settings: dict[str, Any]
) -> None:
    """North stays north in a rotation of 72° about the vertical, which permutes the cells."""
    network = IcosphereUNet(3, 5, 2, table, (6, 8, 8), **settings).double()
    with_statistics(network)
    directions = icosphere_directions(2, "faces" if table is face_neighbors else "vertices")
    rotated = directions @ rotation_about((0, 0, 1), np.radians(72)).T
    distance, order = cKDTree(directions).query(rotated)
    assert distance.max() < 1e-9
    signals = torch.randn(2, 3, 1, len(directions), dtype=torch.double)
    network.eval()
    scores = network(signals)
    assert scores.shape == (2, 5, 1, len(directions))
    if table is not gnomonic_points:  # their grid at a pole is aligned to longitude 0
        torch.testing.assert_close(network(signals[..., order]), scores[..., order])
    assert not torch.allclose(network(signals.roll(1, -1)), scores.roll(1, -1))
    network.train()(signals).square().sum().backward()
    assert all(p.grad is not None and p.grad.abs().max() > 0 for p in network.parameters())


@pytest.mark.parametrize("pooling", ["mean", "max"])
def test_faces_are_pooled_with_their_siblings(pooling: Pooling) -> None:
    network = IcosphereUNet(3, 5, 1, face_neighbors, (4, 6), pooling, "repeat")
    assert network(torch.randn(2, 3, 1, 80)).shape == (2, 5, 1, 80)
    layers = dict(network.named_modules())
    pool, unpool = layers["downs.0.0"], layers["ups.0.up.0"]
    x = torch.arange(80.0).reshape(1, 1, 1, 80)
    expected = torch.arange(20.0) * 4 + (1.5 if pooling == "mean" else 3)
    torch.testing.assert_close(pool(x).ravel(), expected)
    torch.testing.assert_close(unpool(pool(x)).ravel(), expected.repeat_interleave(4))


def test_new_vertices_are_the_mean_of_the_two_old_ones_next_to_them() -> None:
    table, faces = vertex_parents(3).matrix.toarray(), icosphere(3).faces
    count = table.shape[1]
    np.testing.assert_array_equal(table[:count], np.eye(count))
    for vertex in range(count, len(table)):
        around = np.unique(faces[(faces == vertex).any(axis=1)])
        parents = around[around < count]
        expected = np.bincount(parents, minlength=count) / 2
        assert len(parents) == 2
        np.testing.assert_array_equal(table[vertex], expected)


def test_pooled_vertices_are_the_mean_with_their_neighbors() -> None:
    table, faces = vertex_means(2).matrix.toarray(), icosphere(2).faces
    assert table.shape == (42, 162)
    for vertex in (0, *range(12, 42)):  # a pole and all with six neighbors
        around = np.setdiff1d(faces[(faces == vertex).any(axis=1)], [vertex])
        expected = np.bincount(around, minlength=162) * 6 / len(around) / 7
        expected[vertex] = 1 / 7
        np.testing.assert_allclose(table[vertex], expected, atol=1e-12)
