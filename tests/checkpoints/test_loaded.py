"""Trained networks come out of checkpoints as they went in."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from tangent_train.checkpoints.content import read_checkpoint
from tangent_train.checkpoints.loaded import completed_settings, load_network
from tangent_train.checkpoints.scores import size_multiple_of
from tangent_train.errors import DataError
from tests.tasks.odd_networks import Looking, OneSize
from tests.tasks.small_networks import save_checkpoint

SMALL_UNET = ["network=unet", "network.widths=[4,8,8]"]
PHOTOS = ["data=synthrooms_perspective", "representation=perspective", "representation.dim=[12,20]"]


@pytest.mark.parametrize(
    ("overrides", "size", "multiple"),
    [
        (SMALL_UNET, (16, 16), 4),
        ([*SMALL_UNET, "representation=erp_crops", "+data.fill=edge"], (32, 64), 4),
        ([*SMALL_UNET, *PHOTOS], (12, 20), 4),
        (["network=deeplabv3_mobilenet", "data.inputs=[rgb]", "level=5"], (32, 32), 1),
    ],
    ids=["tangent", "erp", "photos", "dict"],
)
def test_a_network_computes_what_its_task_does(
    overrides: list[str], size: tuple[int, int], multiple: int, tmp_path: Path
) -> None:
    path = tmp_path / "best.ckpt"
    task = save_checkpoint(path, *overrides)
    trained = load_network(path)
    assert trained.inputs == (("rgb", "depth") if "network=unet" in overrides else ("rgb",))
    images = torch.randn(2, trained.in_channels, *size)
    with torch.no_grad():
        torch.testing.assert_close(trained.network(images), task(images), rtol=0, atol=0)
    assert not any(module.training for module in trained.network.modules())
    assert trained.image_size == size
    assert (trained.size_multiple, trained.fixed_size) == (multiple, None)
    assert trained.class_names == task.class_names
    assert trained.fill == ("edge" if "+data.fill=edge" in overrides else "mean")
    assert trained.level == (5 if "level=5" in overrides else 4)
    assert trained.normalization.channels == 2 + len(trained.inputs)
    assert trained.representation["_target_"].startswith("tangent_train.rendering.")


class Coarse(nn.Conv2d):
    """A network whose scores are smaller than its images unless those are multiples of 6."""

    def forward(self, images: Tensor) -> Tensor:
        rows, columns = (side // 6 * 6 for side in images.shape[-2:])
        return super().forward(images[..., :rows, :columns])


@pytest.mark.parametrize(
    ("network", "multiple"),
    [
        (nn.Conv2d(3, 5, 3, padding=1), 1),
        (Looking(3, 5), 1),
        (nn.Sequential(nn.AvgPool2d(8), nn.Upsample(scale_factor=8)), 8),
        (nn.Sequential(nn.AvgPool2d(14), nn.Upsample(scale_factor=14)), 14),
        (OneSize(3, 5), None),
        (Coarse(3, 5, 1), None),
        (nn.Conv2d(4, 5, 1), None),
    ],
    ids=["any", "looking", "eighths", "patches of 14", "one", "sixths", "other channels"],
)
def test_sizes_that_a_network_takes_are_found(network: nn.Module, multiple: int | None) -> None:
    assert size_multiple_of(network.eval(), 3) == multiple


def test_nulls_of_networks_inside_networks_are_completed() -> None:
    settings = {"in_channels": None, "x": None, "inner": {"classes": None, "weights": "coco"}}
    completed = completed_settings(settings, 3, 7)
    assert completed == {"in_channels": 3, "x": None, "inner": {"classes": 7, "weights": "coco"}}
    assert completed_settings(settings, 3, 7, restored=True)["inner"]["weights"] is None


def _network(**settings: Any) -> dict[str, Any]:
    return {"_target_": "models.UNet", "in_channels": 4, "num_classes": 13, **settings}


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"network": _network(widths=[4, 8])}, r"other tensors than .*the tensors of models\.UNet"),
        ({"network": {"_target_": "no_such.Net"}}, r"network\._target_: no_such\.Net, .*PYTHON"),
        ({"network": {"_target_": "torch.nn.Convolution"}}, r"network\..*, .*Correct the name"),
        ({"network": _network(wide=3)}, r"network\.wide=3; expected one of its set"),
        ({"network": _network(widths=[])}, r"network: models\.UNet cannot be made"),
        ({"representation": None}, r"no representation in its config"),
    ],
)
def test_files_that_cannot_be_loaded_are_explained(
    changed: dict[str, Any], message: str, tmp_path: Path
) -> None:
    path = tmp_path / "best.ckpt"
    save_checkpoint(path, *SMALL_UNET)
    content = torch.load(path, weights_only=True)
    content["config"] |= changed
    torch.save(content, path)
    with pytest.raises(DataError, match=rf"(?s)^{re.escape(str(path))}: found {message}"):
        load_network(path, ["no_such.Net", "torch.nn.Convolution"])


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "no such file"),
        (b"not a checkpoint", r"a damaged file, or not a file of torch\.save"),
        ({"state_dict": {}}, "no config inside"),
        ([1, 2], "list instead of a mapping inside"),
    ],
)
def test_other_files_are_refused(content: Any, message: str, tmp_path: Path) -> None:
    path = tmp_path / "x.ckpt"
    if isinstance(content, bytes):
        path.write_bytes(content)
    elif content is not None:
        torch.save(content, path)
    with pytest.raises(DataError, match=f"{message}.*expected a checkpoint written by tangent"):
        read_checkpoint(path)
