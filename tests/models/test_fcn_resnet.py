"""FCN-ResNet against torchvision's own, with weights made here in all the forms files have."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any
from urllib.error import URLError

import pytest
import torch
from torch import Tensor, nn
from torchvision.models import ResNet50_Weights, resnet50
from torchvision.models.segmentation import FCN_ResNet50_Weights, fcn_resnet50

from models import FCNResNet
from tangent_train.errors import DataError, SettingError

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from torchvision.models import WeightsEnum

LAST = ("classifier.4.weight", "classifier.4.bias")
State = dict[str, Tensor]


@pytest.fixture(scope="module")
def published() -> nn.Module:
    """What torchvision publishes: 21 classes, an auxiliary classifier, statistics of some data."""
    torch.manual_seed(0)
    network: nn.Module = fcn_resnet50(
        weights=None, weights_backbone=None, num_classes=21, aux_loss=True
    )
    for module in network.modules():
        if isinstance(module, nn.BatchNorm2d):
            nn.init.uniform_(module.running_mean, -0.1, 0.1)  # type: ignore[arg-type]
            nn.init.uniform_(module.running_var, 0.9, 1.1)  # type: ignore[arg-type]
    return network.eval()


@pytest.fixture(scope="module")
def fcn_file(published: nn.Module, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("weights") / "fcn.pth"
    torch.save(published.state_dict(), path)
    return path


def _resnet(published: nn.Module) -> State:
    """The classifier that has the same backbone, saved before batches were counted."""
    state: State = resnet50(weights=None).state_dict()
    for name, tensor in published.state_dict().items():
        if name.startswith("backbone."):
            state[name.removeprefix("backbone.")] = tensor
    return {n: t for n, t in state.items() if "num_batches_tracked" not in n}


def _checkpoint(published: nn.Module) -> dict[str, Any]:
    tensors = {f"network.{n}": t for n, t in published.state_dict().items() if "aux" not in n}
    return {"epoch": 3, "config": {"level": 8}, "state_dict": {"class_weights": 1, **tensors}}


@pytest.mark.parametrize("num_classes", [14, 21])
def test_all_but_the_last_layer_is_loaded_and_computes_what_torchvision_does(
    published: nn.Module, fcn_file: Path, num_classes: int
) -> None:
    network = FCNResNet(3, num_classes, 50, weights=fcn_file).eval()
    state = published.state_dict()
    own = network.state_dict()
    assert set(own) == {n for n in state if not n.startswith("aux")}
    assert all(torch.equal(tensor, state[n]) for n, tensor in own.items() if n not in LAST)
    assert num_classes != 21 or not torch.equal(own[LAST[0]], state[LAST[0]])
    network.classifier[4] = published.get_submodule("classifier.4")  # type: ignore[operator]
    images = torch.randn(2, 3, 64, 96)
    with torch.no_grad():
        assert torch.equal(network(images), published(images)["out"])


@pytest.mark.parametrize(("make", "head"), [(_resnet, False), (_checkpoint, True)])
def test_the_form_of_the_file_is_found_out(
    published: nn.Module, make: Callable[[nn.Module], Any], head: bool, tmp_path: Path
) -> None:
    torch.save(make(published), tmp_path / "x.pth")
    network = FCNResNet(3, 14, 50, weights=tmp_path / "x.pth")
    state = published.state_dict()
    for name, tensor in network.state_dict().items():
        if name.startswith("backbone.") and "num_batches_tracked" not in name:
            assert torch.equal(tensor, state[name]), name
    assert torch.equal(
        network.state_dict()["classifier.0.weight"], state["classifier.0.weight"]
    ) is (head)


def test_depth_changes_no_bit_before_the_first_step(fcn_file: Path) -> None:
    networks = []
    for in_channels in (3, 4):
        torch.manual_seed(1)  # of the last layer
        networks.append(FCNResNet(in_channels, 14, 50, weights=fcn_file))
    images = torch.randn(2, 4, 64, 64)
    scores = []
    for network, in_channels in zip(networks, (3, 4), strict=True):
        torch.manual_seed(2)  # of the dropout
        scores.append(network(images[:, :in_channels]))
    assert torch.equal(*scores)
    scores[1].square().mean().backward()
    gradient = networks[1].get_parameter("backbone.conv1.weight").grad
    assert gradient is not None
    assert gradient[:, 3].abs().min() > 0, "depth is learned"


@pytest.mark.parametrize(
    ("weights", "enum"),
    [
        ("coco", FCN_ResNet50_Weights.COCO_WITH_VOC_LABELS_V1),
        ("imagenet", ResNet50_Weights.IMAGENET1K_V1),
    ],
)
def test_published_weights_come_from_the_cache_or_the_internet(
    published: nn.Module,
    weights: str,
    enum: WeightsEnum,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))

    def refuse(url: str, *_: Any, **__: Any) -> None:
        assert url == enum.url
        raise URLError("no route to host")

    with monkeypatch.context() as patch:
        patch.setattr(torch.hub, "download_url_to_file", refuse)
        message = r"pth: found no way to fetch it .*no route.* set network\.weights to its path"
        with pytest.raises(DataError, match=message):
            FCNResNet(3, 14, 50, weights=weights)
    cached = tmp_path / "hub" / "checkpoints" / enum.url.rpartition("/")[2]
    torch.save(published.state_dict() if weights == "coco" else _resnet(published), cached)
    network = FCNResNet(4, 14, 50, weights=weights)
    stem = published.get_parameter("backbone.conv1.weight")
    assert torch.equal(network.get_parameter("backbone.conv1.weight")[:, :3], stem)


def _without(state: State) -> State:
    return {n: t for n, t in state.items() if not n.startswith("backbone.layer4.2")}


def _with_more(state: State) -> State:
    return {**state, "backbone.layer4.3.conv1.weight": torch.zeros(1)}


def _reshaped(state: State) -> State:
    return {**state, "classifier.0.weight": torch.zeros(5, 3)}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (_without, r'Missing key.*"backbone\.layer4\.2\.conv1\.weight"'),
        (
            _with_more,
            r'Unexpected key.*"backbone\.layer4\.3\.conv1\.weight".*; expected the tensors',
        ),
        (_reshaped, r"size mismatch for classifier\.0\.weight"),
    ],
)
def test_tensors_that_do_not_fit_are_named(
    published: nn.Module, change: Callable[[State], State], message: str, tmp_path: Path
) -> None:
    torch.save(change(dict(published.state_dict())), tmp_path / "x.pth")
    with pytest.raises(DataError, match=f"(?s){message}"):
        FCNResNet(3, 14, 50, weights=tmp_path / "x.pth")


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"depth": 34}, r"network\.depth: found 34; expected 50 or 101"),
        ({"depth": 50, "in_channels": 1}, r"network\.in_channels: found 1"),
        ({"depth": 50, "weights": "voc"}, r"network\.weights: found voc; expected null, coco"),
    ],
)
def test_impossible_settings_are_refused(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(SettingError, match=message):
        FCNResNet(**{"in_channels": 3, "num_classes": 14, **settings})


@pytest.mark.parametrize("frozen", [True, False])
def test_frozen_statistics_train_as_in_evaluation(fcn_file: Path, frozen: bool) -> None:
    network = FCNResNet(3, 14, 50, weights=fcn_file, frozen_statistics=frozen)
    before = {name: buffer.clone() for name, buffer in network.named_buffers()}
    images = torch.randn(2, 3, 64, 64)
    training = network.train()(images)
    assert all(torch.equal(before[name], b) for name, b in network.named_buffers()) is frozen
    training.sum().backward()
    assert network.get_parameter("backbone.bn1.weight").grad is not None
    assert torch.equal(training, network.eval()(images)) is frozen
    assert network.training is False
