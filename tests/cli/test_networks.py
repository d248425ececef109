"""Every network of the config tree takes RGB and RGB-D, and what `build` fills in for it."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from hydra import compose, initialize_config_dir
from omegaconf import DictConfig

from tangent_train.cli.compose import config_folder
from tangent_train.cli.run import build

NETWORKS = sorted(path.stem for path in (config_folder() / "network").glob("*.yaml"))
MAKER = {
    "deeplabv3_mobilenet": "torchvision.models.segmentation.deeplabv3.DeepLabV3",
    "fcn_resnet": "models.fcn_resnet.FCNResNet",
    "hexunet": "models.hexunet.HexUNet",
    "smp_unet": "segmentation_models_pytorch.decoders.unet.model.Unet",
    "unet": "models.unet.UNet",
    "unet_small": "models.unet.UNet",
}


def _composed(*overrides: str) -> DictConfig:
    with initialize_config_dir(str(config_folder()), version_base="1.3"):
        return compose("train", ["level=5", "representation.erp_height=32", *overrides])


@pytest.mark.parametrize("network", NETWORKS)
def test_every_network_takes_the_data_s_channels_and_classes(network: str) -> None:
    shallow = ["network.depth=50"] if network == "fcn_resnet" else []
    for inputs, channels in (("[rgb]", 3), ("[rgb,depth]", 4)):
        config = _composed(f"network={network}", f"data.inputs={inputs}", *shallow)
        _, task = build(config)
        made = type(task.network)
        assert f"{made.__module__}.{made.__name__}" == MAKER[network]
        scores = task(torch.randn(2, channels, 32, 32))
        assert scores.shape == (2, 14, 32, 32)
    scores.square().mean().backward()
    unused = [name for name, p in task.named_parameters() if p.grad is None]
    assert not unused, "parameters without gradient"


def test_timm_encoders_come_with_segmentation_models_pytorch() -> None:
    _, task = build(_composed("network=smp_unet", "network.encoder_name=tu-resnet18"))
    assert type(task.network.encoder.model).__module__.startswith("timm.")


class Recorder(torch.nn.Conv2d):
    """A network that remembers its settings."""

    def __init__(self, in_channels: int, classes: int, **settings: Any) -> None:
        super().__init__(in_channels, classes, 1)
        self.settings = settings


@pytest.mark.parametrize("from_checkpoint", [None, "checkpoint", "resume"])
def test_nulls_are_filled_in_and_weights_left_to_the_checkpoint(
    from_checkpoint: str | None,
) -> None:
    config = _composed()
    config.network = {
        "_target_": f"{__name__}.Recorder",
        "in_channels": None,
        "classes": None,
        "num_classes": 3,
        "weights": "coco",
        "other": None,
        "inner": {"in_channels": None, "encoder_weights": "imagenet", "level": "${level}"},
    }
    if from_checkpoint is not None:
        config = DictConfig({**config, from_checkpoint: "x"})
    _, task = build(config)
    weights, inner = (None, None) if from_checkpoint else ("coco", "imagenet")
    assert task.network.in_channels == 4
    assert task.network.out_channels == 14
    assert task.network.settings == {
        "num_classes": 3,
        "weights": weights,
        "other": None,
        "inner": {"in_channels": 4, "encoder_weights": inner, "level": 5},
    }
