"""Trained networks come out of checkpoints as they went in."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import nn

from models import IcoCNN, UNet
from tangent_train.checkpoints.loaded import (
    METADATA_KEY,
    completed_settings,
    declared_sizes,
    load_network,
)
from tangent_train.checkpoints.outputs import plain_output
from tangent_train.errors import DataError
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
        torch.testing.assert_close(
            trained.network(images), plain_output(task(images)), rtol=0, atol=0
        )
    assert not any(module.training for module in trained.network.modules())
    assert trained.image_size == size
    assert (trained.size_multiple, trained.fixed_size) == (multiple, None)
    assert trained.class_names == task.head.class_names
    assert trained.fill == ("edge" if "+data.fill=edge" in overrides else "mean")
    assert trained.level == (5 if "level=5" in overrides else 4)
    assert trained.normalization.channels == 2 + len(trained.inputs)
    assert trained.representation["_target_"].startswith("tangent_train.rendering.")


class Upsampled(nn.Sequential):
    """A network that declares its stride."""

    size_multiple = 14


@pytest.mark.parametrize(
    ("network", "sizes"),
    [
        (nn.Conv2d(3, 5, 3, padding=1), (1, None)),
        (UNet(3, 5, [4, 8, 8]), (4, None)),
        (nn.Sequential(UNet(3, 5, [4, 8, 8])), (4, None)),
        (Upsampled(), (14, None)),
        (IcoCNN(3, 5, 2, [1, 1]), (1, (1, 162))),
    ],
    ids=["undeclared", "strided", "inside", "user-defined", "icosphere"],
)
def test_sizes_are_declared_by_networks(network: nn.Module, sizes: Any) -> None:
    assert declared_sizes(network) == sizes


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
        ({"settings": _network(widths=[4, 8])}, r".*expected all tensors of UNet"),
        ({"settings": {"_target_": "os.system"}}, r"network\._target_=?.*os\.system"),
        ({"representation": None}, r".*representation=null, not a valid dict"),
        ({"depth_kind": "inverse"}, r".*depth_kind=inverse, not "),
    ],
)
def test_files_that_cannot_be_loaded_are_explained(
    changed: dict[str, Any], message: str, tmp_path: Path
) -> None:
    path = tmp_path / "best.ckpt"
    save_checkpoint(path, *SMALL_UNET)
    content = torch.load(path, weights_only=True)
    content[METADATA_KEY] |= changed
    torch.save(content, path)
    with pytest.raises(DataError, match=rf"(?s)^{re.escape(str(path))}: found {message}"):
        load_network(path)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "No such file"),
        (b"not a checkpoint", r"a damaged file, or not a file of torch\.save"),
        ([1, 2], "no description of a network"),
    ],
)
def test_other_files_are_refused(content: Any, message: str, tmp_path: Path) -> None:
    path = tmp_path / "x.ckpt"
    if isinstance(content, bytes):
        path.write_bytes(content)
    elif content is not None:
        torch.save(content, path)
    with pytest.raises(DataError, match=f"{message}.*expected a network of tangent-train"):
        load_network(path)


def test_only_arguments_that_name_weights_are_null() -> None:
    kept = {"use_checkpoint": True, "class_weights": [1.0], "pretrained_window_size": 3}
    null = ("weights", "encoder_weights", "weights_backbone", "pretrained", "checkpoint_path")
    settings = {"_target_": "models.UNet", **kept, **dict.fromkeys(null, "imagenet")}
    found = completed_settings(settings, 3, 2, restored=True)
    assert {name: found[name] for name in kept} == kept
    assert all(found[name] is None for name in null)
