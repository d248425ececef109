"""Networks. Other `nn.Module` classes that map images to scores can be named by ``_target_``."""

from models.auxiliary_head import AuxiliaryHead
from models.distortion_aware import make_distortion_aware
from models.fcn_resnet import FCNResNet
from models.harmonic_network import HarmonicNetwork
from models.hexunet import HexUNet
from models.huggingface import HuggingFaceDepthNetwork, HuggingFaceNetwork
from models.icocnn import IcoCNN
from models.icosphere_unet import IcosphereUNet
from models.initialization import initialize
from models.mapped import MappedConv, Table
from models.shape_classifier import ShapeClassifier
from models.sphere_attention import SphereAttention
from models.sphere_context import SphereContext
from models.stem import widen_stem
from models.tables import (
    face_neighbors,
    gnomonic_points,
    hexagonal_rings,
    mapped_samples,
    mesh_operators,
)
from models.unet import UNet
from models.zonal import ZonalClassifier

__all__ = [
    "AuxiliaryHead",
    "FCNResNet",
    "HarmonicNetwork",
    "HexUNet",
    "HuggingFaceDepthNetwork",
    "HuggingFaceNetwork",
    "IcoCNN",
    "IcosphereUNet",
    "MappedConv",
    "ShapeClassifier",
    "SphereAttention",
    "SphereContext",
    "Table",
    "UNet",
    "ZonalClassifier",
    "face_neighbors",
    "gnomonic_points",
    "hexagonal_rings",
    "initialize",
    "make_distortion_aware",
    "mapped_samples",
    "mesh_operators",
    "widen_stem",
]
