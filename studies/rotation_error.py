"""Rotation errors of networks: ``python -m studies.rotation_error <method>=<checkpoint> …``.

The error of a network f is ‖f(Rx) − R f(x)‖ / ‖f(x) − mean‖, for the probabilities f(x) of a smooth
random signal x and a rotation R.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor, nn

from studies.output import Row, save
from tangent_train.checkpoints.loaded import load_network
from tangent_train.config.build import build_from_config
from tangent_train.geometry import (
    equirect_directions,
    equirect_solid_angles,
    icosphere,
    random_rotation,
)
from tangent_train.geometry.icosphere import icosphere_directions
from tangent_train.rendering import IcosphereRepresentation, rotate_equirect
from tangent_train.rendering.mosaic import ScoreMosaic

Array = NDArray[np.float64]


def icosahedral_rotations() -> Array:
    """Return the ``(60, 3, 3)`` rotations that map the icosahedron to itself, the identity first.

    A rotation is determined by the directed edge to which it maps a given one.
    """
    edges = icosphere(0).faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    first, second = np.moveaxis(icosphere_directions(0)[edges], 1, 0)
    frames = np.stack([first, second, np.cross(first, second)], axis=-1)
    return frames @ np.linalg.inv(frames[0])


def signal(directions: Array, waves: int = 64, largest: float = 8.0) -> Tensor:
    """Return four sums ``(4, …)`` of random plane waves at directions ``(…, 3)``, of variance 1.

    Args:
        directions: Unit vectors.
        waves: Number of waves.
        largest: Upper limit of their radians per unit of length.
    """
    rng = np.random.default_rng(0)
    vectors = rng.uniform(-1, 1, (3, 4, waves)) * largest / 3**0.5
    phases = np.tensordot(directions, vectors, 1) + rng.uniform(0, 2 * np.pi, (4, waves))
    return torch.from_numpy(np.cos(phases).sum(-1) * (2 / waves) ** 0.5).float().movedim(-1, 0)


def probabilities(network: nn.Module, representation: Any, panorama: Tensor) -> Tensor:
    """Return ``(K, H, W)`` probabilities of a panorama."""
    (views,) = representation.view_sets()
    scores = network(views.render(panorama, "bilinear"))
    shape = panorama.shape[1], panorama.shape[2]
    mosaic = ScoreMosaic(shape, scores.shape[1], representation.blend, averaged=True)
    mosaic.add(scores, views)
    return mosaic.probabilities(slice(None)).movedim(-1, 0)


@torch.no_grad()
def mean_error(
    network: nn.Module, representation: Any, rotations: Array, by_cells: bool = False
) -> float:
    """Return the mean error of rotations in percent.

    Args:
        network: Maps views to scores.
        representation: The views of a panorama.
        rotations: ``(n, 3, 3)``.
        by_cells: True to compare signals on the vertices or faces of an icosphere, which the
            rotations permute, instead of panoramas, which are resampled.
    """
    shape = representation.erp_height, 2 * representation.erp_height
    directions, areas = equirect_directions(shape), equirect_solid_angles(shape)[:, None]
    if by_cells:
        directions = icosphere_directions(representation.level, representation.elements)[None]
        areas = np.ones((1, 1))
    weights, tree = torch.from_numpy(areas), cKDTree(directions[0])

    def run(rotation: Array) -> Tensor:
        x = signal(directions @ rotation)
        if by_cells:
            scores: Tensor = network(x[None])
            return scores.softmax(dim=1)[0]
        return probabilities(network, representation, x)

    def norm(x: Tensor) -> float:
        return float((x.square() * weights).sum().sqrt())

    expected, errors = run(np.eye(3)), []
    mean = (expected * weights).sum(dim=(1, 2)) / weights.expand(expected.shape[1:]).sum()
    for rotation in rotations:
        if by_cells:
            rotated = expected[..., tree.query(directions[0] @ rotation)[1]]
        else:
            rotated = rotate_equirect(expected, rotation)
        errors.append(norm(run(rotation) - rotated) / norm(expected - mean[:, None, None]))
    return 100 * float(np.mean(errors))


def rotation_error(name: str, checkpoint: str, count: int = 20) -> Row:
    """Return mean errors in percent with random and with trained weights.

    The icosahedral group permutes signals on an icosphere. Other views are resampled; the last
    column is the error of a 1×1 convolution on the same views, of which resampling is the cause.

    Args:
        name: Name of the method.
        checkpoint: File of the trained network.
        count: Number of rotations of each group.
    """
    trained, rng = load_network(Path(checkpoint)), np.random.default_rng(1)
    representation = build_from_config(trained.representation, "representation")
    by_cells = isinstance(representation, IcosphereRepresentation)
    group = rng.permutation(icosahedral_rotations()[1:])[:count]
    rotations = np.stack([random_rotation(rng) for _ in range(count)])
    torch.manual_seed(0)
    random = build_from_config(trained.settings, "network")
    for module in random.modules():  # statistics of the signal
        if isinstance(module, nn.BatchNorm2d):
            module.momentum = None
    pixels = equirect_directions((representation.erp_height, 2 * representation.erp_height))
    with torch.no_grad():
        probabilities(random.train(), representation, signal(pixels))
    networks = {"random weights": random.eval(), "trained": trained.module}
    row: Row = {"method": name}
    for weights, network in networks.items():
        row[f"icosahedral group, {weights}"] = mean_error(network, representation, group, by_cells)
    for weights, network in networks.items():
        row[f"SO(3), {weights}"] = mean_error(network, representation, rotations)
    pointwise = nn.Conv2d(trained.in_channels, len(trained.class_names) - 1, 1)
    row["SO(3), 1 × 1 convolution"] = mean_error(pointwise, representation, rotations)
    return {
        title: f"{float(f'{v:.2g}'):g}" if isinstance(v, float) else v for title, v in row.items()
    }


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("methods", nargs="+", metavar="<method>=<checkpoint>")
    named = (text.partition("=") for text in parser.parse_args().methods)
    table = [rotation_error(name, checkpoint) for name, _, checkpoint in named]
    save("rotation_error", table)
