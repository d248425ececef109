"""Classifiers of images, as torchvision and timm have them, on the views of whole shapes."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor, nn

from models.stem import widen_stem
from models.views import each_view
from tangent_train.errors import SettingError
from tangent_train.registry import registered

__all__ = ["MultiView"]

_DIMENSIONS = 3
"""Of scores: shapes, views, classes."""


@registered
class MultiView(nn.Module):
    """Shows a classifier every view of a shape by itself and averages the scores.

    So networks trained on photos classify shapes (after Su et al. 2015, who pool features by
    their maximum). The first convolution takes further channels, their filters starting at zero;
    of trained weights, a last layer for other classes is replaced by a fresh one.

    Args:
        network: Any classifier ``(B, C, h, w) -> (B, K)``.
        in_channels: Channels of an image; where the first convolution takes others it has to be one
            for three, and these have to be more.
        num_classes: Classes.

    Raises:
        SettingError: The first or the last layer cannot be fitted.
    """

    def __init__(self, network: nn.Module, in_channels: int, num_classes: int) -> None:
        super().__init__()
        stem = next((m for m in network.modules() if isinstance(m, nn.Conv2d)), None)
        if stem is None or stem.in_channels != in_channels:
            widen_stem(network, in_channels)
        _fit_head(network, num_classes)
        self.network = network

    def forward(
        self, images: Float[Tensor, "batch views channels height width"]
    ) -> Float[Tensor, "batch classes"]:
        """Scores of the classes, from any number of views of every shape.

        Raises:
            SettingError: The network gives no scores of the classes, or the images are not those of
                shapes.
        """
        scores = each_view(self._scores, images)
        if scores.ndim != _DIMENSIONS:
            raise SettingError(
                f"scores of {type(self.network).__name__}",
                found=f"an array of shape {tuple(scores.shape[1:])} for every shape",
                expected="(views, classes)",
                remedy="Its network must be one that classifies images.",
            )
        return scores.mean(dim=1)

    def _scores(self, images: Tensor) -> Tensor:
        found = self.network(images)
        # GoogLeNet and Inception, while training: auxiliary scores follow, which nothing learns by.
        scores: Tensor = found[0] if isinstance(found, tuple) else found
        return scores


def _fit_head(network: nn.Module, num_classes: int) -> None:
    """Let the last layer, in the order of definition, give so many scores, in place."""
    layers = [n for n, m in network.named_modules() if isinstance(m, nn.Linear | nn.Conv2d)]
    parent, _, name = layers[-1].rpartition(".")
    head = network.get_submodule(layers[-1])
    fresh: nn.Module
    if isinstance(head, nn.Linear):
        count = head.out_features
        fresh = nn.Linear(head.in_features, num_classes, bias=head.bias is not None)
    elif isinstance(head, nn.Conv2d) and head.kernel_size == (1, 1) and name:
        count = head.out_channels
        fresh = nn.Conv2d(head.in_channels, num_classes, 1, bias=head.bias is not None)
    else:
        raise SettingError(
            f"last layer of {type(network).__name__}",
            found=head,
            expected="a linear one, or a 1×1 convolution, with a score for every class",
        )
    if count != num_classes:
        setattr(network.get_submodule(parent), name, fresh)
