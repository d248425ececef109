"""FCN-ResNet against torchvision's tensors, with fabricated weights in all the forms of files."""

from __future__ import annotations

from pathlib import Path
from typing import Any
from urllib.error import URLError

import pytest
import torch
from torch import Tensor, nn
from torchvision.models import ResNet50_Weights, resnet50
from torchvision.models.segmentation import fcn_resnet50

from models import FCNResNet
from tangent_train.errors import DataError
from tests.tasks.small_networks import with_statistics

LAST = ("classifier.4.weight", "classifier.4.bias")
State = dict[str, Tensor]


@pytest.fixture(scope="module")
def published() -> nn.Module:
    """As torchvision publishes it: 21 classes, an auxiliary classifier, statistics of some data."""
    torch.manual_seed(0)
    network = fcn_resnet50(weights=None, weights_backbone=None, num_classes=21, aux_loss=True)
    return with_statistics(network).eval()


def _resnet(published: nn.Module) -> State:
    """The classifier that has the same backbone, saved before batches were counted."""
    state: State = resnet50(weights=None).state_dict()
    for name, tensor in published.state_dict().items():
        if name.startswith("backbone."):
            state[name.removeprefix("backbone.")] = tensor
    return {n: t for n, t in state.items() if "num_batches_tracked" not in n}


@pytest.mark.parametrize("form", ["fcn", "resnet"])
def test_all_that_the_file_has_but_the_last_layer_is_loaded(
    published: nn.Module, form: str, tmp_path: Path
) -> None:
    state = published.state_dict()
    torch.save(_resnet(published) if form == "resnet" else state, tmp_path / "x.pth")
    network = FCNResNet(3, 21, 50, weights=tmp_path / "x.pth").eval()
    tensors = {n: t for n, t in network.state_dict().items() if "num_batches_tracked" not in n}
    same = {name for name, tensor in tensors.items() if torch.equal(tensor, state[name])}
    head = set() if form == "resnet" else {n for n in tensors if n.startswith("classifier.")}
    assert same >= {n for n in tensors if n.startswith("backbone.")} | head - set(LAST)
    assert not same & {LAST[0]}
    if head:
        network.load_state_dict({n: state[n] for n in LAST}, strict=False)
        images = torch.randn(2, 3, 64, 96)
        with torch.no_grad():
            assert torch.equal(network(images), published(images)["out"])


def test_published_weights_come_from_the_cache_or_the_internet(
    published: nn.Module, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    url = ResNet50_Weights.IMAGENET1K_V1.url

    def refuse(wanted: str, *_: Any, **__: Any) -> None:
        assert wanted == url
        raise URLError("no route to host")

    with monkeypatch.context() as patch:
        patch.setattr(torch.hub, "download_url_to_file", refuse)
        message = r"found no way to fetch it .*no route.* save it as .*hub/checkpoints/resnet50-"
        with pytest.raises(DataError, match=message):
            FCNResNet(3, 14, 50, weights="imagenet")
    torch.save(_resnet(published), tmp_path / "hub" / "checkpoints" / url.rpartition("/")[2])
    stem = published.get_parameter("backbone.conv1.weight")
    tensors = FCNResNet(4, 14, 50, weights="imagenet").get_parameter("backbone.conv1.weight")
    assert torch.equal(tensors[:, :3], stem)
    assert not tensors[:, 3].any(), "depth changes nothing before the first step"


@pytest.mark.parametrize("frozen", [True, False])
def test_frozen_statistics_train_as_in_evaluation(frozen: bool) -> None:
    network = FCNResNet(3, 14, 50, frozen_statistics=frozen)
    before = {name: buffer.clone() for name, buffer in network.named_buffers()}
    images = torch.randn(2, 3, 64, 64)
    training = network.train()(images)
    assert all(torch.equal(before[name], b) for name, b in network.named_buffers()) is frozen
    training.sum().backward()
    assert network.get_parameter("backbone.bn1.weight").grad is not None
    assert torch.equal(training, network.eval()(images)) is frozen
    assert network.training is False
