from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import nn
from torchvision import models as torchvision_models

from models import MultiView, ShapeClassifier, widen_stem
from tangent_train.errors import SettingError
from tests.tasks.small_networks import with_statistics


def test_parameters_are_those_of_the_released_code() -> None:
    """Of the other width the docstring counts them."""
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


MAKERS = ["resnet18", "mobilenet_v3_small"]
"""The last layer is alone or in a sequence."""


def _torchvision(name: str, **settings: Any) -> nn.Module:
    network: nn.Module = torchvision_models.get_model(name, weights=None, **settings)
    return network


def test_scores_are_the_mean_over_the_views() -> None:
    torch.manual_seed(0)
    inner = with_statistics(_torchvision("resnet18", num_classes=5)).eval()
    network = MultiView(inner, 3, 5).eval()
    images = torch.randn(2, 4, 3, 32, 32)
    with torch.no_grad():
        expected = torch.stack([inner(views).mean(dim=0) for views in images])
        torch.testing.assert_close(network(images), expected, rtol=1e-4, atol=1e-5)
        torch.testing.assert_close(network(images.flip(1)), expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("name", MAKERS)
def test_trained_layers_stay_and_the_first_and_last_are_fitted(name: str) -> None:
    torch.manual_seed(0)
    trained = with_statistics(_torchvision(name))
    before = {n: t.clone() for n, t in trained.state_dict().items()}
    network = MultiView(trained, 6, 7).eval()
    after = network.network.state_dict()
    changed = [n for n, t in after.items() if t.shape != before[n].shape]
    assert {n.rpartition(".")[2] for n in changed} == {"weight", "bias"}
    stem, *head = sorted(changed, key=list(after).index)
    assert torch.equal(after[stem][:, :3], before[stem])
    assert not after[stem][:, 3:].any(), "filters of further channels start at zero"
    assert {n.rpartition(".")[0] for n in head} == {list(after)[-1].rpartition(".")[0]}
    assert all(torch.equal(t, before[n]) for n, t in after.items() if n not in changed)
    assert network(torch.randn(2, 3, 6, 64, 64)).shape == (2, 7)


@pytest.mark.parametrize(
    ("network", "message"),
    [
        (nn.Conv2d(3, 2, 1), r"last layer of Conv2d: found Conv2d"),
        (nn.Conv2d(1, 2, 1), r"first convolution of Conv2d: found Conv2d\(1, 2"),
        (nn.Conv2d(3, 3, 1, groups=3), "first convolution of Conv2d"),
        (nn.Linear(3, 2), "first convolution of Linear: found none"),
    ],
)
def test_what_cannot_be_fitted_is_refused(network: nn.Module, message: str) -> None:
    with pytest.raises(SettingError, match=message):
        MultiView(network, 6, 3)
    with pytest.raises(SettingError, match=r"network\.in_channels: found 2; expected 3 or more"):
        widen_stem(network, 2)
