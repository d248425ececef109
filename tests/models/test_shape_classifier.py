from __future__ import annotations

from typing import Any

import torch

from models import ShapeClassifier
from tests.tasks.small_networks import with_statistics


def test_parameters_are_those_of_the_released_code() -> None:
    """The docstring's example counts those of the other width."""
    assert sum(p.numel() for p in ShapeClassifier(6, 40, width=32).parameters()) == 5_135_880


def test_scores_are_of_the_mean_over_views_and_positions() -> None:
    torch.manual_seed(0)
    network: Any = with_statistics(ShapeClassifier(6, 5, 4)).eval()
    shape, other = torch.randn(2, 3, 6, 16, 48)
    with torch.no_grad():
        assert network.features[:3](shape).min() == 0
        features = network.features(shape)
        assert features.shape == (3, 256, 1, 3)
        expected = network.head.weight @ features.mean(dim=(0, 2, 3)) + network.head.bias
        scores = network(torch.stack([other, shape.flip(0)]))
    torch.testing.assert_close(scores[1], expected, rtol=1e-4, atol=1e-5)
