"""Networks that halve the resolution can only take sides they can halve."""

from __future__ import annotations

from torch import Tensor

from tangent_train.errors import SettingError

__all__ = ["check_sides"]


def check_sides(images: Tensor, stride: int, network: str, remedy: str = "") -> None:
    """Refuse images whose sides are no multiples of the network's stride.

    Args:
        images: ``(B, C, h, w)``.
        stride: Pixels of the image per pixel of the coarsest features.
        network: Its name in the message.
        remedy: Which other setting of the network would help, a clause.

    Raises:
        SettingError: A side is no multiple.
    """
    height, width = images.shape[-2:]
    if height % stride or width % stride:
        raise SettingError(
            f"image size for the {network}",
            found=f"{height}×{width}",
            expected=f"sides that are multiples of {stride}",
            remedy=f"Choose another representation.dim or level{remedy}.",
        )
