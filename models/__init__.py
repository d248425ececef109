"""Networks. Other `nn.Module` classes that map images to scores can be named by ``_target_``.

Each is imported on first use: ``models.UNet`` imports ``models/unet.py`` only.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from models.auxiliary_head import AuxiliaryHead as AuxiliaryHead
    from models.distortion_aware import make_distortion_aware as make_distortion_aware
    from models.fcn_resnet import FCNResNet as FCNResNet
    from models.harmonic_network import HarmonicNetwork as HarmonicNetwork
    from models.hexunet import HexUNet as HexUNet
    from models.huggingface import HuggingFaceDepthNetwork as HuggingFaceDepthNetwork
    from models.huggingface import HuggingFaceNetwork as HuggingFaceNetwork
    from models.icocnn import IcoCNN as IcoCNN
    from models.icosphere_unet import IcosphereUNet as IcosphereUNet
    from models.initialization import initialize as initialize
    from models.mapped import MappedConv as MappedConv
    from models.mapped import Table as Table
    from models.shape_classifier import ShapeClassifier as ShapeClassifier
    from models.sphere_attention import SphereAttention as SphereAttention
    from models.sphere_context import SphereContext as SphereContext
    from models.stem import widen_stem as widen_stem
    from models.tables import face_neighbors as face_neighbors
    from models.tables import gnomonic_points as gnomonic_points
    from models.tables import hexagonal_rings as hexagonal_rings
    from models.tables import mapped_samples as mapped_samples
    from models.tables import mesh_operators as mesh_operators
    from models.unet import UNet as UNet
    from models.zonal import ZonalClassifier as ZonalClassifier

_FILES = {
    "AuxiliaryHead": "auxiliary_head",
    "FCNResNet": "fcn_resnet",
    "HarmonicNetwork": "harmonic_network",
    "HexUNet": "hexunet",
    "HuggingFaceDepthNetwork": "huggingface",
    "HuggingFaceNetwork": "huggingface",
    "IcoCNN": "icocnn",
    "IcosphereUNet": "icosphere_unet",
    "MappedConv": "mapped",
    "ShapeClassifier": "shape_classifier",
    "SphereAttention": "sphere_attention",
    "SphereContext": "sphere_context",
    "Table": "mapped",
    "UNet": "unet",
    "ZonalClassifier": "zonal",
    "face_neighbors": "tables",
    "gnomonic_points": "tables",
    "hexagonal_rings": "tables",
    "initialize": "initialization",
    "make_distortion_aware": "distortion_aware",
    "mapped_samples": "tables",
    "mesh_operators": "tables",
    "widen_stem": "stem",
}

__all__ = list(_FILES)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


def __getattr__(name: str) -> Any:
    if name not in _FILES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_FILES[name]}"), name)
