"""Networks; any other `nn.Module` that maps images to scores works too, named by `_target_`."""

from models.unet import UNet

__all__ = ["UNet"]
