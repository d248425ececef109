"""Networks. Other `nn.Module` classes that map images to scores can be named by ``_target_``."""

from models.depth_anything_3 import DepthAnything3 as DepthAnything3
from models.distortion_aware import make_distortion_aware as make_distortion_aware
from models.fcn_resnet import FCNResNet as FCNResNet
from models.harmonic_network import HarmonicNetwork as HarmonicNetwork
from models.hexunet import HexUNet as HexUNet
from models.huggingface import HuggingFaceDepthNetwork as HuggingFaceDepthNetwork
from models.huggingface import HuggingFaceNetwork as HuggingFaceNetwork
from models.icocnn import IcoCNN as IcoCNN
from models.icosphere_unet import IcosphereUNet as IcosphereUNet
from models.mapped import MappedConv as MappedConv
from models.mapped import Table as Table
from models.mapped import face_neighbors as face_neighbors
from models.mapped import gnomonic_points as gnomonic_points
from models.mapped import hexagonal_rings as hexagonal_rings
from models.mapped import mapped_samples as mapped_samples
from models.mapped import mesh_operators as mesh_operators
from models.mask_rcnn import MaskRCNN as MaskRCNN
from models.pretrained import initialize as initialize
from models.pretrained import widen_stem as widen_stem
from models.prompted import PromptedNetwork as PromptedNetwork
from models.shape_classifier import ShapeClassifier as ShapeClassifier
from models.spherical_cnn import SphericalCNN as SphericalCNN
from models.stages import AuxiliaryHead as AuxiliaryHead
from models.unet import UNet as UNet
from models.zonal import ZonalClassifier as ZonalClassifier
