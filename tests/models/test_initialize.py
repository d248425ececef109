"""Starting from other networks' tensors, in the forms their files have."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest
import torch
from rich.console import Console
from safetensors.torch import save_file
from torch import Tensor, nn

from models.initialize import initialize, origins_table
from tangent_train.errors import DataError

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path


def _network(channels: int = 3, classes: int = 5) -> nn.Module:
    return nn.Sequential(
        nn.Conv2d(channels, 4, 3), nn.BatchNorm2d(4), nn.Conv2d(4, 4, 1), nn.Conv2d(4, classes, 1)
    )


def _save_checkpoint(tensors: dict[str, Tensor], path: Path) -> None:
    inside = {f"network.{n}": t for n, t in tensors.items()}
    torch.save({"state_dict": {"class_weights": torch.ones(5), **inside}, "epoch": 1}, path)


def _save_lightning(tensors: dict[str, Tensor], path: Path) -> None:
    torch.save({"state_dict": {f"model.net.{n}": t for n, t in tensors.items()}}, path)


def _save_parallel(tensors: dict[str, Tensor], path: Path) -> None:
    torch.save({f"module.{n}": t for n, t in tensors.items()}, path)


def _save_safetensors(tensors: dict[str, Tensor], path: Path) -> None:
    save_file(tensors, path)


@pytest.mark.parametrize(
    ("save", "suffix"),
    [
        (_save_checkpoint, ".ckpt"),
        (_save_lightning, ".ckpt"),
        (_save_parallel, ".pth"),
        (torch.save, ".pt"),
        (_save_safetensors, ".safetensors"),
    ],
)
def test_any_file_gives_the_same_network(
    save: Callable[[dict[str, Tensor], Path], None], suffix: str, tmp_path: Path
) -> None:
    other, network = _network(), _network()
    path = tmp_path / f"other{suffix}"
    save(other.state_dict(), path)
    origins = initialize(network, path)
    torch.testing.assert_close(network.state_dict(), other.state_dict(), rtol=0, atol=0)
    assert len(origins.loaded) == len(other.state_dict())
    assert not origins.adapted
    assert not origins.fresh
    assert not origins.unused


def test_depth_starts_at_zero_and_other_classes_afresh(tmp_path: Path) -> None:
    rgb, network = _network(3, 21), _network(4, 5)
    before = {name: tensor.clone() for name, tensor in network.state_dict().items()}
    torch.save(rgb.state_dict() | {"aux.weight": torch.ones(1)}, tmp_path / "rgb.pt")
    origins = initialize(network, tmp_path / "rgb.pt")
    assert origins.adapted == {"0.weight": "3 → 4 channels"}
    assert set(origins.fresh) == {"3.weight", "3.bias"}
    assert origins.fresh["3.bias"] == "(21,) in the file, (5,) here"
    assert origins.unused == ("aux.weight",)
    torch.testing.assert_close(network.state_dict()["3.weight"], before["3.weight"])
    image = torch.randn(2, 4, 6, 6)
    for module in (rgb, network):
        module.eval()
    assert torch.equal(rgb[:3](image[:, :3]), network[:3](image))  # type: ignore[index]
    with Console(width=200).capture() as _, Console(record=True, width=200) as console:
        console.print(origins_table(origins, "rgb.pt"))
    assert "3.bias: (21,) in the file, (5,) here" in console.export_text()


def test_channels_that_the_network_lacks_are_left_out(tmp_path: Path) -> None:
    rgbd, network = _network(4), _network(3)
    torch.save(rgbd.state_dict(), tmp_path / "rgbd.pt")
    assert initialize(network, tmp_path / "rgbd.pt").adapted == {"0.weight": "4 → 3 channels"}
    torch.testing.assert_close(
        network.state_dict()["0.weight"], rgbd.state_dict()["0.weight"][:, :3]
    )


def test_what_does_not_fit_at_all_is_refused(tmp_path: Path) -> None:
    torch.save({"head.weight": torch.zeros(3)}, tmp_path / "other.pt")
    with pytest.raises(DataError, match=r"other\.pt: found no tensor that fits, but head\.weight"):
        initialize(_network(), tmp_path / "other.pt")
    (tmp_path / "broken.safetensors").write_bytes(b"nothing")
    with pytest.raises(DataError, match=r"broken\.safetensors: found an unreadable file"):
        initialize(_network(), tmp_path / "broken.safetensors")
    with pytest.raises(DataError, match="no such file"):
        initialize(_network(), tmp_path / "nowhere.pt")
