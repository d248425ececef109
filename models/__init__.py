"""Networks; any other `nn.Module` that maps images to scores works too, named by `_target_`."""

from models.auxiliary_head import AuxiliaryHead
from models.fcn_resnet import FCNResNet
from models.hexunet import HexUNet
from models.initialize import initialize
from models.multi_view import MultiView
from models.shape_classifier import ShapeClassifier
from models.sphere_attention import SphereAttention
from models.sphere_context import SphereContext
from models.stem import widen_stem
from models.unet import UNet

__all__ = [
    "AuxiliaryHead",
    "FCNResNet",
    "HexUNet",
    "MultiView",
    "ShapeClassifier",
    "SphereAttention",
    "SphereContext",
    "UNet",
    "initialize",
    "widen_stem",
]
