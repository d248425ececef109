"""Seam scores against counting pairs one by one."""

from __future__ import annotations

import math

import numpy as np
import pytest

from tangent_train.geometry import TangentGrid, equirect_directions
from tangent_train.inference import seams
from tangent_train.inference.seams import seam_score


def test_against_a_loop_over_all_pairs() -> None:
    grid, (height, width) = TangentGrid(1, 5), (24, 48)
    labels = np.random.default_rng(0).integers(0, 4, (height, width))
    owners = grid.owners(equirect_directions((height, width)))
    counts = {True: [0.0, 0.0], False: [0.0, 0.0]}
    for i in range(height):
        weight = math.cos(math.pi / 2 - (i + 0.5) / height * math.pi)
        for j in range(width):
            for other in ((i, (j + 1) % width), (i + 1, j)):
                if other[0] < height and labels[i, j] and labels[other]:
                    border = bool(owners[i, j] != owners[other])
                    counts[border][0] += weight * (labels[i, j] != labels[other])
                    counts[border][1] += weight
    score = seam_score(labels, grid)
    assert score.border == pytest.approx(counts[True][0] / counts[True][1])
    assert score.inside == pytest.approx(counts[False][0] / counts[False][1])
    assert score.ratio == pytest.approx(score.border / score.inside)


def test_labels_that_are_the_owner_disagree_at_borders_only() -> None:
    grid = TangentGrid(0, 5)
    owners = grid.owners(equirect_directions((64, 128))) + 1
    score = seam_score(owners, grid)
    assert (score.border, score.inside) == (1.0, 0.0)
    assert math.isnan(score.ratio)


def test_noise_does_not_know_borders() -> None:
    labels = np.random.default_rng(1).integers(1, 3, (128, 256))
    assert seam_score(labels, TangentGrid(0, 6)).ratio == pytest.approx(1, abs=0.05)


def test_nothing_known_is_nan() -> None:
    score = seam_score(np.zeros((16, 32), int), TangentGrid(0, 4))
    assert math.isnan(score.border)
    assert math.isnan(score.ratio)


@pytest.mark.parametrize("height", [40, 41, 64, 100])
def test_tall_panoramas_are_looked_at_in_steps(
    monkeypatch: pytest.MonkeyPatch, height: int
) -> None:
    """Of labels that are the owners, all borders show and nothing else does, at any step."""
    grid = TangentGrid(0, 5)
    owners = grid.owners(equirect_directions((height, 2 * height))) + 1
    monkeypatch.setattr(seams, "_MOST_ROWS", 40)
    assert seam_score(owners, grid) == (1.0, 0.0)
