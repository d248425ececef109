"""The network of the paper's shape classification."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor, nn

from models.residual import Down
from models.stride import check_sides
from models.views import each_view
from tangent_train.errors import SettingError
from tangent_train.registry import registered

__all__ = ["ShapeClassifier"]

_GROWTH = 4
"""Times as many channels after every halving."""

_HALVINGS = 3
"""After the first convolution, which halves too."""


@registered
class ShapeClassifier(nn.Module):
    """Classifies a shape by all of its tangent images (paper, supplement, "Shape classification").

    After Jiang et al. (2019): a 3×3 convolution of stride 2 and three residual blocks, each
    halving, the same for every image; the mean over images and positions; a linear layer. For six
    channels and 40 classes it has the 1,309,976 (`width` 16) and 5,135,880 (32) trainable
    parameters of the released code.

    In training, batch normalization sees all images of all shapes together. The released code shows
    the network the first image of every shape, then the second one of every shape, and so on.

    Args:
        in_channels: Channels of an image.
        num_classes: Classes.
        width: Channels after the first convolution; 64 times as many are averaged in the end.
        dropout: Share of the averaged features that training leaves out.

    Raises:
        SettingError: A setting that cannot work.

    Example:
        >>> sum(p.numel() for p in ShapeClassifier(6, 40).parameters())
        1309976
    """

    stride = 2 ** (1 + _HALVINGS)

    def __init__(
        self, in_channels: int, num_classes: int, width: int = 16, dropout: float = 0.5
    ) -> None:
        super().__init__()
        if not isinstance(width, int) or width < 1:
            raise SettingError("network.width", found=width, expected="a whole number from 1")
        if not 0 <= dropout < 1:
            raise SettingError("network.dropout", found=dropout, expected="0 to less than 1")
        widths = [width * _GROWTH**k for k in range(_HALVINGS + 1)]
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
        """Scores of the classes, from any number of views of every shape.

        Raises:
            SettingError: A side is no multiple of the network's stride, 16, or the images are not
                those of shapes.
        """
        check_sides(images, self.stride, "ShapeClassifier")
        positions = each_view(self.features, images)
        scores: Tensor = self.head(self.dropout(positions.mean(dim=(1, 3, 4))))
        return scores
