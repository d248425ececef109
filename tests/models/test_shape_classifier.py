from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import nn

from models import ShapeClassifier, widen_stem
from tangent_train.errors import SettingError
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


@pytest.mark.parametrize(
    ("network", "message"),
    [
        (nn.Conv2d(1, 2, 1), r"first convolution of Conv2d: found Conv2d\(1, 2"),
        (nn.Conv2d(3, 3, 1, groups=3), "first convolution of Conv2d"),
        (nn.Linear(3, 2), "first convolution of Linear: found none"),
    ],
)
def test_other_first_convolutions_are_refused(network: nn.Module, message: str) -> None:
    with pytest.raises(SettingError, match=message):
        widen_stem(network, 6)
