"""The network of the paper's shape classification."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor, nn

from models.unet import Down

_WIDTHS = (1, 4, 16, 64)
"""Channels after the first convolution and after each residual block, in units of `width`."""


class ShapeClassifier(nn.Module):
    """Classifies a shape by all of its tangent images (paper, supplement, "Shape classification").

    After Jiang et al. (2019): a 3×3 convolution of stride 2 and three residual blocks that halve
    the resolution, shared by all images; the mean over images and positions; a linear layer. With
    six channels and 40 classes it has the 1,309,976 (`width` 16) and 5,135,880 (32) trainable
    parameters of the released code.

    In training, batch normalization sees all images of all shapes together. The released code
    passes the first images of all shapes through the network, then all second images, and so on.

    Args:
        in_channels: Channels of an image.
        num_classes: Number of classes.
        width: Channels after the first convolution.
        dropout: Dropout rate before the linear layer.

    Example:
        >>> sum(p.numel() for p in ShapeClassifier(6, 40).parameters())
        1309976
    """

    size_multiple = 2 ** len(_WIDTHS)

    def __init__(
        self, in_channels: int, num_classes: int, width: int = 16, dropout: float = 0.5
    ) -> None:
        super().__init__()
        widths = [width * times for times in _WIDTHS]
        self.features = nn.Sequential(
            nn.Conv2d(in_channels, width, 3, stride=2, padding=1),
            nn.BatchNorm2d(width),
            nn.ReLU(inplace=True),
            *map(Down, widths[:-1], widths[1:]),
        )
        self.dropout = nn.Dropout(dropout)
        self.head = nn.Linear(widths[-1], num_classes)

    def forward(
        self, images: Float[Tensor, "batch views channels height width"]
    ) -> Float[Tensor, "batch classes"]:
        """Return class scores of shapes, each seen in any number of views."""
        features = self.features(images.flatten(0, 1)).unflatten(0, images.shape[:2])
        scores: Tensor = self.head(self.dropout(features.mean(dim=(1, 3, 4))))
        return scores
