"""Image classifiers, such as those of torchvision and timm, on the views of whole shapes."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor, nn

from models.stem import first_convolution, widen_stem
from tangent_train.errors import SettingError
from tangent_train.registry import registered


@registered
class MultiView(nn.Module):
    """Classify every view of a shape separately and average the scores.

    Networks trained on photos can thus classify shapes (after Su et al. 2015, who max-pool
    features). The first convolution is widened to further channels, whose filters start at zero; a
    last layer for another number of classes is replaced by an untrained one.

    Args:
        network: An image classifier ``(B, C, h, w) -> (B, K)``, whose last layer is linear.
        in_channels: Channels of an image: those of the first convolution, or more if it takes RGB.
        num_classes: Classes.

    Raises:
        SettingError: The first or the last layer cannot be adapted.
    """

    def __init__(self, network: nn.Module, in_channels: int, num_classes: int) -> None:
        super().__init__()
        if first_convolution(network).in_channels != in_channels:
            widen_stem(network, in_channels)
        _fit_head(network, num_classes)
        self.network = network

    def forward(
        self, images: Float[Tensor, "batch views channels height width"]
    ) -> Float[Tensor, "batch classes"]:
        """Class scores of shapes, each seen in any number of views."""
        scores: Tensor = self.network(images.flatten(0, 1))
        return scores.reshape(*images.shape[:2], -1).mean(dim=1)


def _fit_head(network: nn.Module, num_classes: int) -> None:
    """Replace the last layer, in order of definition, unless its outputs match the classes."""
    layers = [n for n, m in network.named_modules() if isinstance(m, nn.Linear | nn.Conv2d)]
    head = network.get_submodule(layers[-1])
    if not isinstance(head, nn.Linear):
        raise SettingError(
            f"last layer of {type(network).__name__}",
            found=head,
            expected="a linear one, with a score for every class",
        )
    if head.out_features != num_classes:
        fresh = nn.Linear(head.in_features, num_classes, bias=head.bias is not None)
        network.set_submodule(layers[-1], fresh)
