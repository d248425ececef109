"""Starting from other networks' tensors, in the forms their files have."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import save_file
from torch import Tensor, nn

from models import AuxiliaryHead, initialize
from tangent_train.errors import DataError
from tests.models.sphere_networks import STAGE, awake, small_unet


def _network(channels: int = 3, classes: int = 5) -> nn.Module:
    return nn.Sequential(
        nn.Conv2d(channels, 4, 3), nn.BatchNorm2d(4), nn.Conv2d(4, 4, 1), nn.Conv2d(4, classes, 1)
    )


OURS = {"prefix": "network.", "beside": {"class_weights": torch.ones(5)}}
LIGHTNING: dict[str, Any] = {"prefix": "model.net.", "beside": {}}


def _save(
    tensors: dict[str, Tensor],
    path: Path,
    prefix: str = "",
    beside: dict[str, Tensor] | None = None,
) -> None:
    """Write tensors under other names; in a checkpoint, beside others."""
    named = {f"{prefix}{name}": tensor for name, tensor in tensors.items()}
    if path.suffix == ".safetensors":
        save_file(named, path)
    else:
        torch.save(named if beside is None else {"state_dict": named | beside, "epoch": 1}, path)


@pytest.mark.parametrize(
    ("suffix", "form"),
    [
        (".ckpt", OURS),
        (".ckpt", LIGHTNING),
        (".pth", {"prefix": "module."}),
        (".pt", {}),
        (".safetensors", {}),
    ],
)
def test_any_file_gives_the_same_network(suffix: str, form: dict[str, Any], tmp_path: Path) -> None:
    other, network = _network(), _network()
    path = tmp_path / f"other{suffix}"
    _save(other.state_dict(), path, **form)
    origins = initialize(network, path)
    torch.testing.assert_close(network.state_dict(), other.state_dict(), rtol=0, atol=0)
    assert len(origins.loaded) == len(other.state_dict())
    assert not origins.adapted
    assert not origins.fresh
    assert not origins.unused


@pytest.mark.parametrize(
    "wrapped",
    [
        lambda tensors: {"model": tensors, "epoch": 3, "best": torch.tensor(0.5)},
        lambda tensors: {"model_state_dict": tensors, "optimizer_state_dict": {"state": {}}},
        lambda tensors: {"checkpoint": {"net": _named("module._orig_mod.", tensors)}},
        lambda tensors: {"meta": {"classes": ["a"]}, "state_dict": _named("backbone.", tensors)},
        lambda tensors: {"state_dict": _named("model.", tensors) | {"loss.weight": torch.ones(2)}},
        lambda tensors: {"state_dict": tensors, "state_dict_ema": _changed(tensors)},
        lambda tensors: {"model": tensors, "ema": dict(tensors)},
        lambda tensors: {"model": tensors, "optimizer": {"state": {0: {"exp_avg": torch.ones(3)}}}},
        lambda tensors: {"first": _part(tensors, "01"), "rest": _part(tensors, "23")},
        lambda tensors: tensors | {"nothing": None},
        lambda tensors: {"log": {str(k): {"loss": k} for k in range(200)}, "model": tensors},
        lambda tensors: {name: nn.Parameter(t) for name, t in tensors.items() if t.ndim},
    ],
)
def test_state_dicts_are_found_in_what_people_save(wrapped: Any, tmp_path: Path) -> None:
    other, network = _network(), _network()
    tensors = other.state_dict()
    content = wrapped(tensors)
    if "first" in content:
        other = nn.ModuleDict({"first": other[:2], "rest": other[2:]})  # type: ignore[index]
        network = nn.ModuleDict({"first": network[:2], "rest": network[2:]})  # type: ignore[index]
    torch.save(content, tmp_path / "x.pt")
    assert not initialize(network, tmp_path / "x.pt").unused
    for name, parameter in other.named_parameters():
        assert torch.equal(network.get_parameter(name), parameter)


def _named(prefix: str, tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    return {prefix + name: tensor for name, tensor in tensors.items()}


def _changed(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    return {name: tensor + 1 for name, tensor in tensors.items()}


def _part(tensors: dict[str, Tensor], layers: str) -> dict[str, Tensor]:
    return {name: tensor for name, tensor in tensors.items() if name[0] in layers}


def test_depth_starts_at_zero_and_other_classes_untrained(tmp_path: Path) -> None:
    rgb, network = _network(3, 21), _network(4, 5)
    before = {name: tensor.clone() for name, tensor in network.state_dict().items()}
    torch.save(rgb.state_dict() | {"aux.weight": torch.ones(1)}, tmp_path / "rgb.pt")
    origins = initialize(network, tmp_path / "rgb.pt")
    assert origins.adapted == {"0.weight": "starts at zero: channel 3"}
    assert set(origins.fresh) == {"3.weight", "3.bias"}
    assert origins.unused == ("aux.weight",)
    torch.testing.assert_close(network.state_dict()["3.weight"], before["3.weight"])
    image = torch.randn(2, 4, 6, 6)
    for module in (rgb, network):
        module.eval()
    assert torch.equal(rgb[:3](image[:, :3]), network[:3](image))  # type: ignore[index]


@pytest.mark.parametrize(
    ("now", "places", "change"),
    [
        ("RGBE", [0, 1, 2, None], "starts at zero: E; left out: D"),
        ("RGBED", [0, 1, 2, None, 3], "starts at zero: E"),
        ("RGBD", [0, 1, 2, 3], None),
    ],
)
def test_filters_go_by_the_names_of_their_channels(
    tmp_path: Path, now: str, places: list[int | None], change: str | None
) -> None:
    rgbd, network = _network(4), _network(len(now))
    torch.save(rgbd.state_dict(), tmp_path / "rgbd.pt")
    origins = initialize(network, tmp_path / "rgbd.pt", (tuple("RGBD"), tuple(now)))
    assert origins.adapted == ({} if change is None else {"0.weight": change})
    before, after = rgbd.state_dict()["0.weight"], network.state_dict()["0.weight"]
    for channel, place in enumerate(places):
        expected = torch.zeros_like(before[:, 0]) if place is None else before[:, place]
        torch.testing.assert_close(after[:, channel], expected, rtol=0, atol=0)


def test_a_file_without_a_fitting_tensor_is_refused(tmp_path: Path) -> None:
    torch.save({"head.weight": torch.zeros(3)}, tmp_path / "other.pt")
    with pytest.raises(DataError, match=r"other\.pt: found no tensor that fits, but head\.weight"):
        initialize(_network(), tmp_path / "other.pt")
    (tmp_path / "broken.safetensors").write_bytes(b"nothing")
    with pytest.raises(DataError, match=r"broken\.safetensors: found an unreadable file"):
        initialize(_network(), tmp_path / "broken.safetensors")
    with pytest.raises(DataError, match="No such file"):
        initialize(_network(), tmp_path / "nowhere.pt")


def _wrapped(layers: str) -> nn.Module:
    """A small UNet, perhaps inside an auxiliary head (``a``) and another module (``o``)."""
    network: nn.Module = small_unet()
    if "a" in layers:
        network = AuxiliaryHead(network, STAGE, in_channels=3, num_classes=4)
    if "o" in layers:
        network = nn.ModuleDict({"network": network, "other": nn.Linear(2, 3)})
    return awake(network)


def _plain(network: nn.Module) -> dict[str, Tensor]:
    """Tensors by the names that they have without wrappers."""
    return {name.replace("network.", ""): t for name, t in network.state_dict().items()}


def _kinds(names: Iterable[str]) -> set[str]:
    """The wrappers' own parts that names belong to; others are the UNet's."""
    parts = ("other", "auxiliary_head")
    return {next((part for part in parts if part in name), "unet") for name in names}


@pytest.mark.parametrize(("saved", "wanted"), [("", "ao"), ("ao", ""), ("a", "ao")])
def test_networks_fit_into_the_wrappers_of_others(saved: str, wanted: str, tmp_path: Path) -> None:
    other, network = _wrapped(saved), _wrapped(wanted)
    _save(other.state_dict(), tmp_path / "other.ckpt", **LIGHTNING)
    origins = initialize(network, tmp_path / "other.ckpt")
    part = {"a": "auxiliary_head", "o": "other"}
    both = {part[layer] for layer in saved if layer in wanted}
    assert _kinds(origins.loaded) == {"unet"} | both
    assert _kinds(origins.fresh) == {part[layer] for layer in wanted if layer not in saved}
    assert _kinds(origins.unused) == {part[layer] for layer in saved if layer not in wanted}
    assert not origins.adapted
    given = _plain(other)
    for name, tensor in _plain(network).items():
        assert name not in given or torch.equal(tensor, given[name])


def test_scores_of_other_classes_are_left_out_though_they_fit(tmp_path: Path) -> None:
    other, network = _network(), _network()
    torch.save(other.state_dict(), tmp_path / "x.pt")
    head = {"3.weight": network.state_dict()["3.weight"].clone()}
    origins = initialize(network, tmp_path / "x.pt", of_other_classes=head)
    assert origins.fresh == {"3.weight": "of other classes in the file"}
    assert torch.equal(network.state_dict()["3.weight"], head["3.weight"])
    assert torch.equal(network.state_dict()["3.bias"], other.state_dict()["3.bias"])


def test_every_tensor_that_is_not_loaded_is_named(tmp_path: Path) -> None:
    network = nn.Sequential(_network(64), nn.Linear(2, 2))
    found = {f"0.{name}": t for name, t in _network(64).state_dict().items()}
    found |= {"0.0.weight": torch.ones(4, 64, 5, 5), "0.odd": torch.ones(2)}
    del found["0.3.bias"]
    torch.save(found, tmp_path / "x.pt")
    lines = str(initialize(network, tmp_path / "x.pt")).splitlines()
    assert lines[1:] == [
        "untrained: 4",
        "  (4, 64, 5, 5) in the file, (4, 64, 3, 3) here: 0.0.weight",
        "  not in the file: 0.3.bias, 1.weight, 1.bias",
        "not used: 1",
        "  not in the network: 0.odd",
    ]
