"""Rotation errors of networks: ``python -m studies.rotation_error [<method>=<checkpoint> …]``.

The error of a network f is ‖f(Rx) − R f(x)‖ / ‖f(x) − mean‖, for its probabilities f of a smooth
random signal x and a rotation R. Networks have random weights, or those of a checkpoint.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from hydra import compose, initialize_config_dir
from numpy.typing import NDArray
from omegaconf import OmegaConf
from scipy.spatial import cKDTree
from torch import Tensor, nn

from benchmarks.methods import METHODS
from studies.output import Row, markdown
from tangent_train.checkpoints.trained import load_trained
from tangent_train.cli.run import build
from tangent_train.files import config_folder, csv_text, write_text
from tangent_train.geometry import equirect_directions, equirect_solid_angles, random_rotation
from tangent_train.geometry.icosphere import icosphere
from tangent_train.geometry.icosphere_signals import icosphere_directions
from tangent_train.rendering import IcosphereRepresentation, rotate_equirect
from tangent_train.rendering.mosaic import ScoreMosaic

Array = NDArray[np.float64]
CHANNELS, CLASSES = 4, 13
POINTWISE = {
    f"1×1 convolution, {name}": f"network=unet_small representation={name}"
    for name in ("tangent", "erp", "icosphere")
}
"""A network without errors of its own, on different views."""


def icosahedral_rotations() -> Array:
    """Return the ``(60, 3, 3)`` rotations that map the icosahedron to itself, the identity first.

    A rotation is determined by the directed edge to which it maps a given one.
    """
    edges = icosphere(0).faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    first, second = np.moveaxis(icosphere_directions(0)[edges], 1, 0)
    frames = np.stack([first, second, np.cross(first, second)], axis=-1)
    return frames @ np.linalg.inv(frames[0])


def signal(directions: Array, waves: int = 64, largest: float = 8.0) -> Tensor:
    """Return ``(4, …)`` sums of random plane waves at directions ``(…, 3)``, of variance 1.

    Args:
        directions: Unit vectors.
        waves: Number of waves.
        largest: Upper limit of their radians per unit of length.
    """
    rng = np.random.default_rng(0)
    vectors = rng.uniform(-1, 1, (3, CHANNELS, waves)) * largest / 3**0.5
    phases = np.tensordot(directions, vectors, 1) + rng.uniform(0, 2 * np.pi, (CHANNELS, waves))
    return torch.from_numpy(np.cos(phases).sum(-1) * (2 / waves) ** 0.5).float().movedim(-1, 0)


def probabilities(network: nn.Module, representation: Any, panorama: Tensor) -> Tensor:
    """Return ``(K, H, W)`` probabilities of a panorama."""
    shape = panorama.shape[1], panorama.shape[2]
    mosaic = ScoreMosaic(shape, CLASSES, representation.blend, averaged=True)
    for views in representation.view_sets():
        mosaic.add(network(views.render(panorama, "bilinear")), views)
    return mosaic.probabilities(slice(None)).movedim(-1, 0)


@torch.no_grad()
def errors(
    network: nn.Module, representation: Any, rotations: Array, by_cells: bool
) -> list[float]:
    """Return the error of each rotation.

    Args:
        network: Maps views to scores.
        representation: The views of a panorama.
        rotations: ``(n, 3, 3)``.
        by_cells: True to compare signals on the vertices or faces of an icosphere, which the
            rotations permute, instead of panoramas, which are resampled.
    """
    shape = representation.erp_height, 2 * representation.erp_height
    directions = equirect_directions(shape)
    weights = torch.from_numpy(equirect_solid_angles(shape)).float()[:, None].expand(shape)
    if by_cells:
        directions = icosphere_directions(representation.level, representation.elements)[None]
        weights = torch.ones(directions.shape[:2])
    tree = cKDTree(directions[0])

    def run(x: Tensor) -> Tensor:
        if by_cells:
            scores: Tensor = network(x[None])
            return scores.softmax(dim=1)[0]
        return probabilities(network, representation, x)

    def rotate(x: Tensor, rotation: Array) -> Tensor:
        if by_cells:
            return x[..., tree.query(directions[0] @ rotation)[1]]
        return rotate_equirect(x, rotation)

    def norm(x: Tensor) -> float:
        return float((x.square() * weights).sum().sqrt())

    expected = run(signal(directions))
    mean = (expected * weights).sum(dim=(1, 2), keepdim=True) / weights.sum()
    differences = (run(signal(directions @ r)) - rotate(expected, r) for r in rotations)
    return [norm(difference) / norm(expected - mean) for difference in differences]


def built(settings: str, level: int) -> tuple[nn.Module, Any]:
    """Return the network of ``experiment=rooms/methods``, with random weights, and its views.

    The statistics of batch normalization are those of the signal.
    """
    overrides = ["experiment=rooms/methods", f"level={level}", "seed=0", *settings.split()]
    with initialize_config_dir(str(config_folder()), version_base="1.3"):
        config: Any = OmegaConf.to_container(compose("train", overrides), resolve=True)
    torch.manual_seed(0)
    data, task = build(config)
    for module in task.network.modules():
        if isinstance(module, nn.BatchNorm2d):
            module.momentum = None
    panorama = signal(equirect_directions((2 ** (level + 1), 2 ** (level + 2))))
    views = data.representation.view_sets()[0]
    with torch.no_grad():
        task.network.train()(views.render(panorama, "bilinear"))
    return task.network.eval(), data.representation


def rotation_error(checkpoints: Mapping[str, str], level: int = 5, count: int = 20) -> list[Row]:
    """Return mean errors in percent of each method, under the icosahedral group and under SO(3).

    Args:
        checkpoints: Files of trained networks, by names of methods.
        level: Level s.
        count: Number of rotations of each group.
    """
    rng, rows = np.random.default_rng(1), []
    group = rng.permutation(icosahedral_rotations()[1:])[:count]
    rotations = np.stack([random_rotation(rng) for _ in range(count)])
    for name, settings in (POINTWISE | METHODS).items():
        network, representation = built(settings, level)
        network = nn.Conv2d(CHANNELS, CLASSES, 1) if name in POINTWISE else network
        for weights in ("random", "trained")[: 1 + (name in checkpoints)]:
            if weights == "trained":
                trained = load_trained(Path(checkpoints[name]))
                network.load_state_dict(trained.inner.state_dict())
            row: Row = {"method": name, "weights": weights}
            by_cells = isinstance(representation, IcosphereRepresentation)
            for title, among in (("icosahedral group %", group), ("SO(3) %", rotations)):
                exact = by_cells and among is group
                row[title] = 100 * float(np.mean(errors(network, representation, among, exact)))
            rows.append(row)
            print(row, file=sys.stderr, flush=True)
    return rows


if __name__ == "__main__":
    table = rotation_error(dict(text.split("=", 1) for text in sys.argv[1:]))
    write_text(Path("figures/rotation_error.csv"), csv_text(list(table[0]), table))
    print(markdown(table, 3))
