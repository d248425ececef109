"""Which stages there are, and how many channels they have."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor, nn
from torchvision.models.segmentation import deeplabv3_mobilenet_v3_large

from models import FCNResNet, HexUNet, UNet
from models.stages import stage_channels
from tangent_train.errors import SettingError


class _Looking(nn.Sequential):
    """Cannot run where there are no values."""

    def forward(self, images: Tensor) -> Tensor:
        result: Tensor = super().forward(images)  # type: ignore[no-untyped-call]
        return result * 2 if bool(images.sum() > 1) else result


class _Twice(nn.Module):
    """Runs one stage twice; the other gives two tensors."""

    def __init__(self) -> None:
        super().__init__()
        self.shared = nn.Conv2d(3, 3, 1)
        self.last = nn.Conv2d(3, 5, 1)
        self.pool = nn.MaxPool2d(2, return_indices=True)

    def forward(self, images: Tensor) -> Tensor:
        features: Tensor = self.last(self.shared(self.shared(images)))
        self.pool(features)
        return features


@pytest.mark.parametrize(
    ("network", "stage", "in_channels", "channels"),
    [
        (UNet(4, 14), "downs.4", 4, 256),
        (UNet(4, 14), "downs.0.1", 4, 32),
        (UNet(4, 14, [4] * 8), "stem", 4, 4),
        (FCNResNet(3, 5, 50), "backbone.layer4", 3, 2048),
        (HexUNet(3, 5), "encoders.1", 3, 64),
        (
            deeplabv3_mobilenet_v3_large(weights=None, weights_backbone=None),
            "backbone.16",
            3,
            960,
        ),
        (_Looking(nn.Conv2d(3, 6, 1), nn.Conv2d(6, 2, 1)), "0", 3, 6),
    ],
    ids=["unet", "deep", "eight", "fcn", "hexunet", "deeplab", "looking"],
)
def test_channels_are_found_by_running_it(
    network: nn.Module, stage: str, in_channels: int, channels: int
) -> None:
    before = {name: tensor.clone() for name, tensor in network.state_dict().items()}
    hooks = sum(len(module._forward_hooks) for module in network.modules())
    assert stage_channels(network, stage, in_channels) == channels
    assert stage_channels(network, stage, None, channels) == channels
    assert network.training
    assert sum(len(module._forward_hooks) for module in network.modules()) == hooks
    torch.testing.assert_close(network.state_dict(), before, rtol=0, atol=0)


@pytest.mark.parametrize(
    ("stage", "in_channels", "channels", "message"),
    [
        (
            "downs.9",
            3,
            None,
            r"stage: found 'downs\.9', which is no part; expected a stage of UNet: "
            r"stem, downs\.0, downs\.1, ups\.0, ups\.1, head\.$",
        ),
        ("", 3, None, "found '', which is no part"),
        ("downs", 3, None, "found 'downs', which does not give one map of features once"),
        ("downs.9", None, 8, r"a stage of UNet: stem, downs, downs\.0"),
        ("downs.1", None, None, r"channels: found null; .* features at downs\.1 have"),
        ("downs.1", 3, 9, r"channels: found 9; expected null, or 8"),
    ],
)
def test_what_is_no_stage_is_refused(
    stage: str, in_channels: int | None, channels: int | None, message: str
) -> None:
    with pytest.raises(SettingError, match=message):
        stage_channels(UNet(3, 4, (4, 6, 8)), stage, in_channels, channels)


@pytest.mark.parametrize("stage", ["shared", "pool"])
def test_stages_without_one_map_of_features_are_refused(stage: str) -> None:
    with pytest.raises(SettingError, match=r"does not give one map of features once.*: last"):
        stage_channels(_Twice(), stage, 3)


def test_a_network_of_one_size_must_be_told() -> None:
    class OneSize(nn.Sequential):
        def forward(self, images: Tensor) -> Tensor:
            assert images.shape[-2:] == (24, 40)
            result: Tensor = super().forward(images)  # type: ignore[no-untyped-call]
            return result

    network = OneSize(nn.Conv2d(3, 6, 1))
    assert stage_channels(network, "0", 3, 6) == 6
    with pytest.raises(SettingError, match=r"only found out .* 64×64 or 224×224 or 896×896"):
        stage_channels(network, "0", 3)
