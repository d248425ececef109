"""Classifiers of photos on the views of shapes."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import nn
from torchvision import models as torchvision_models

from models import MultiView, initialize
from tangent_train.errors import SettingError
from tests.tasks.small_networks import with_statistics

MAKERS = [
    "resnet18",
    "mobilenet_v3_small",
    "squeezenet1_1",
    "shufflenet_v2_x0_5",
    "mnasnet0_5",
]
"""Last layers are linear, in a sequence or alone, and a 1×1 convolution."""


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


def test_a_head_for_the_same_classes_is_kept() -> None:
    trained = _torchvision("resnet18", num_classes=7)
    head = trained.get_parameter("fc.weight")
    assert MultiView(trained, 6, 7).network.get_parameter("fc.weight") is head


def test_a_network_for_as_many_channels_is_left_alone() -> None:
    timm = pytest.importorskip("timm")
    inner = timm.create_model("resnet10t", pretrained=False, in_chans=6, num_classes=9)
    stem = next(m for m in inner.modules() if isinstance(m, nn.Conv2d)).weight
    network = MultiView(inner, 6, 4)
    assert next(m for m in network.modules() if isinstance(m, nn.Conv2d)).weight is stem
    scores = network(torch.randn(2, 3, 6, 32, 32))
    assert scores.shape == (2, 4)
    scores.square().sum().backward()
    assert all(p.grad is not None for p in network.parameters())


def test_it_starts_from_weights_of_the_same_network(tmp_path: Any) -> None:
    torch.manual_seed(0)
    published = _torchvision("resnet18")
    torch.save(published.state_dict(), tmp_path / "resnet18.pth")
    network = MultiView(_torchvision("resnet18", num_classes=10), 6, 10)
    origins = initialize(network, tmp_path / "resnet18.pth")
    assert list(origins.adapted.values()) == ["3 → 6 channels"]
    assert set(origins.fresh) == {"network.fc.weight", "network.fc.bias"}


def test_auxiliary_scores_are_left_out() -> None:
    torch.manual_seed(0)
    inner = _torchvision("googlenet", num_classes=5, init_weights=False)
    network, images = MultiView(inner, 3, 5), torch.randn(2, 2, 3, 32, 32)
    inner.dropout = nn.Identity()
    scores = network(images)
    logits, *auxiliary = inner(images.flatten(0, 1))
    assert len(auxiliary) == 2
    torch.testing.assert_close(scores, logits.reshape(2, 2, 5).mean(dim=1))


@pytest.mark.parametrize(
    ("network", "message"),
    [
        (nn.Sequential(nn.Conv2d(4, 8, 3), nn.Flatten(), nn.Linear(8, 3)), "first convolution"),
        (nn.Sequential(nn.Flatten(), nn.Linear(8, 3)), "first convolution"),
        (nn.Sequential(nn.Conv2d(3, 8, 3), nn.ReLU()), "last layer of Sequential: found Conv2d"),
    ],
)
def test_networks_that_cannot_be_fitted_are_refused(network: nn.Module, message: str) -> None:
    with pytest.raises(SettingError, match=message):
        MultiView(network, 6, 3)


def test_networks_that_score_pixels_are_refused() -> None:
    network: Any = MultiView(nn.Sequential(nn.Conv2d(3, 4, 3), nn.Conv2d(4, 3, 1)), 6, 3)
    with pytest.raises(SettingError, match=r"scores of Sequential: .* \(views, classes\)"):
        network(torch.zeros(2, 5, 6, 8, 8))
