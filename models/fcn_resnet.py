"""FCN-ResNet, the network of the paper's level 10 and transfer experiments."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional
from torch.nn.modules.batchnorm import _BatchNorm

from models.pretrained import fetch_tensors, load_tensors, tensors_for, widen_stem

_PUBLISHED = {
    "coco": "FCN_ResNet{}_Weights.COCO_WITH_VOC_LABELS_V1",
    "imagenet": "ResNet{}_Weights.IMAGENET1K_V1",
}
_HEAD = "classifier."
_LAST = "classifier.4."
_DROPPED = (_LAST, "aux_classifier.", "backbone.fc.")


class FCNResNet(nn.Module):
    """torchvision's FCN on a dilated ResNet, without its auxiliary classifier.

    The last layer is always randomly initialized, and filters of channels after the third start at
    zero (paper, supplement, "Level 10 parameters").

    Args:
        in_channels: Channels of the image: 3 for RGB, 4 for RGB-D.
        num_classes: Classes K.
        depth: 50 or 101.
        weights: Pretrained RGB weights. ``coco``: torchvision's FCN, trained on COCO; ``imagenet``:
            its ResNet; both are downloaded on first use. Or a file: a state dict of the FCN or of
            the ResNet, or a checkpoint of this package. None: random initialization.
        frozen_statistics: Train in evaluation mode, as the released code does: batch normalization
            keeps the statistics of `weights`, and dropout is off.

    Raises:
        DataError: The weights cannot be read.
    """

    def __init__(
        self,
        in_channels: int,
        num_classes: int,
        depth: int = 101,
        weights: str | Path | None = None,
        frozen_statistics: bool = False,
    ) -> None:
        from torchvision.models import get_model  # slow to import, and for this network only

        super().__init__()
        untrained = {"weights": None, "weights_backbone": None, "aux_loss": False}
        fcn: Any = get_model(f"fcn_resnet{depth}", num_classes=num_classes, **untrained)
        self.backbone: nn.Module = fcn.backbone
        self.classifier: nn.Module = fcn.classifier
        self.frozen_statistics = frozen_statistics
        if weights is not None:
            tensors = _tensors(self, str(weights), depth)
            with_head = any(name.startswith(_HEAD) for name in tensors)
            load_tensors(self, tensors, weights, fresh=_LAST if with_head else _HEAD)
        widen_stem(self.backbone, in_channels)
        self.train()

    def train(self, mode: bool = True) -> FCNResNet:
        """Set the mode; with `frozen_statistics`, batch norm and dropout keep evaluation mode."""
        super().train(mode)
        for module in self.modules() if self.frozen_statistics else ():
            if isinstance(module, _BatchNorm | nn.Dropout):
                module.eval()
        return self

    def forward(
        self, images: Float[Tensor, "batch channels height width"]
    ) -> Float[Tensor, "batch classes height width"]:
        """Return scores of every pixel, interpolated from an eighth of the resolution."""
        scores = self.classifier(self.backbone(images)["out"])
        return functional.interpolate(scores, images.shape[-2:], mode="bilinear")


def _tensors(network: nn.Module, weights: str, depth: int) -> dict[str, Tensor]:
    """Return the tensors named by `weights`, under their names in the FCN."""
    if weights in _PUBLISHED:
        tensors = fetch_tensors(_PUBLISHED[weights].format(depth))
    else:
        tensors = tensors_for(network, Path(weights))
    if "conv1.weight" in tensors:  # state dict of a ResNet classifier
        tensors = {f"backbone.{name}": tensor for name, tensor in tensors.items()}
    return {name: t for name, t in tensors.items() if not name.startswith(_DROPPED)}
