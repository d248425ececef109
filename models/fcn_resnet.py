"""FCN-ResNet, the network of the paper's level 10 and transfer experiments."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional
from torchvision.models import ResNet50_Weights, ResNet101_Weights
from torchvision.models.segmentation import (
    FCN_ResNet50_Weights,
    FCN_ResNet101_Weights,
    fcn_resnet50,
    fcn_resnet101,
)

from models.pretrained import fetch_tensors, load_tensors, read_tensors
from models.stem import widen_stem, with_channels
from tangent_train.errors import SettingError
from tangent_train.registry import registered

__all__ = ["FCNResNet"]

_MAKE = {50: fcn_resnet50, 101: fcn_resnet101}
_PUBLISHED = {
    "coco": {
        50: FCN_ResNet50_Weights.COCO_WITH_VOC_LABELS_V1,
        101: FCN_ResNet101_Weights.COCO_WITH_VOC_LABELS_V1,
    },
    "imagenet": {50: ResNet50_Weights.IMAGENET1K_V1, 101: ResNet101_Weights.IMAGENET1K_V1},
}
_STEM = "backbone.conv1.weight"
_HEAD = "classifier."
_LAST = "classifier.4."
_DROPPED = (_LAST, "aux_classifier.", "backbone.fc.")


class _FrozenStatistics(nn.Module):
    """Batch normalization by the statistics it has, while training too; the rest is learned.

    No subclass of torch's, which Lightning's `sync_batchnorm` would replace.
    """

    running_mean: Tensor
    running_var: Tensor

    def __init__(self, learned: nn.BatchNorm2d) -> None:
        super().__init__()
        self.weight, self.bias, self.eps = learned.weight, learned.bias, learned.eps
        for name, buffer in learned.named_buffers():
            self.register_buffer(name, buffer)

    def forward(self, x: Tensor) -> Tensor:
        return functional.batch_norm(
            x, self.running_mean, self.running_var, self.weight, self.bias, eps=self.eps
        )


def _freeze_statistics(network: nn.Module) -> None:
    """Let training compute what evaluation does.

    Not by `eval()`: the next `train()` would undo it, and Lightning warns of modules in that mode.
    """
    for module in list(network.modules()):
        for name, child in module.named_children():
            if isinstance(child, nn.BatchNorm2d):
                module.add_module(name, _FrozenStatistics(child))
            elif isinstance(child, nn.Dropout):
                child.p = 0.0


@registered
class FCNResNet(nn.Module):
    """torchvision's FCN on a dilated ResNet, without its auxiliary classifier.

    The last layer is always fresh, and filters of channels after the third start at zero (paper,
    supplement, "Level 10 parameters").

    Args:
        in_channels: Channels of the image: 3 for RGB, 4 for RGB-D.
        num_classes: Score planes, the unknown class 0 included.
        depth: 50 or 101.
        weights: What to start from. ``coco``: torchvision's FCN, trained on COCO. ``imagenet``: its
            ResNet. Both are fetched on the first use. Or a file: a state dict of the FCN or of the
            ResNet, or a checkpoint of this package. None: random numbers.
        frozen_statistics: Train as in evaluation, which the released code does: batch normalization
            keeps the statistics of `weights`, and nothing is dropped out.

    Raises:
        SettingError: Another depth, less than three channels, or unknown `weights`.
        DataError: The weights cannot be fetched or read, or do not fit.
    """

    def __init__(
        self,
        in_channels: int,
        num_classes: int,
        depth: int = 101,
        weights: str | Path | None = None,
        frozen_statistics: bool = False,
    ) -> None:
        super().__init__()
        if depth not in _MAKE:
            raise SettingError("network.depth", found=depth, expected="50 or 101")
        tensors = None if weights is None else _tensors(str(weights), depth)
        fcn = _MAKE[depth](
            weights=None, weights_backbone=None, num_classes=num_classes, aux_loss=False
        )
        self.backbone: nn.Module = widen_stem(fcn.backbone, in_channels)
        self.classifier: nn.Module = fcn.classifier
        if tensors is not None:
            tensors = _widened(tensors, in_channels)
            with_head = any(name.startswith(_HEAD) for name in tensors)
            load_tensors(self, tensors, weights, fresh=_LAST if with_head else _HEAD)
        if frozen_statistics:
            _freeze_statistics(self)

    def forward(
        self, images: Float[Tensor, "batch channels height width"]
    ) -> Float[Tensor, "batch classes height width"]:
        """Scores of every pixel, interpolated from an eighth of the resolution."""
        scores = self.classifier(self.backbone(images)["out"])
        return functional.interpolate(scores, images.shape[-2:], mode="bilinear")


def _tensors(weights: str, depth: int) -> dict[str, Tensor]:
    """The tensors that `weights` names, under the names of the FCN."""
    if weights in _PUBLISHED:
        tensors = fetch_tensors(_PUBLISHED[weights][depth])
    elif Path(weights).is_file():
        tensors = read_tensors(Path(weights))
    else:
        raise SettingError(
            "network.weights", found=weights, expected="null, coco, imagenet or an existing file"
        )
    if "conv1.weight" in tensors:  # a ResNet classifier
        tensors = {f"backbone.{name}": tensor for name, tensor in tensors.items()}
    return {name: t for name, t in tensors.items() if not name.startswith(_DROPPED)}


def _widened(tensors: Mapping[str, Tensor], in_channels: int) -> dict[str, Tensor]:
    """The same with zero filters for the channels after the third; wider ones are left alone."""
    stem = tensors.get(_STEM)
    if stem is None or stem.shape[1:2] != (3,):
        return dict(tensors)
    return {**tensors, _STEM: with_channels(stem, in_channels)}
