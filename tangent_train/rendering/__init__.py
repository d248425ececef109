"""Render equirectangular panoramas to tangent images, horizontal views or cube faces, and back.

NumPy panoramas are sampled by OpenCV, tensors by differentiable sparse sums on any device, labels
by compiled kernels. All of them follow the convention in `tangent_train.geometry`.
"""

from typing import TYPE_CHECKING

from tangent_train.imports import on_first_use
from tangent_train.rendering.forward import Blend, equirect_to_tangent, perspective, rotate_equirect
from tangent_train.rendering.representations.perspective import PerspectiveRepresentation
from tangent_train.rendering.representations.pinhole import (
    CubemapRepresentation,
    HorizontalRepresentation,
    TangentRepresentation,
)
from tangent_train.rendering.representations.views import Representation
from tangent_train.rendering.resampling import Interpolation

if TYPE_CHECKING:
    from tangent_train.rendering.mosaic import tangent_to_equirect, tangent_to_labels
    from tangent_train.rendering.representations.equirect import EquirectRepresentation
    from tangent_train.rendering.representations.icosphere import IcosphereRepresentation

__all__ = [
    "Blend",
    "CubemapRepresentation",
    "EquirectRepresentation",
    "HorizontalRepresentation",
    "IcosphereRepresentation",
    "Interpolation",
    "PerspectiveRepresentation",
    "Representation",
    "TangentRepresentation",
    "equirect_to_tangent",
    "perspective",
    "rotate_equirect",
    "tangent_to_equirect",
    "tangent_to_labels",
]

_WITH_TORCH = {
    "EquirectRepresentation": "representations.equirect",
    "IcosphereRepresentation": "representations.icosphere",
    "tangent_to_equirect": "mosaic",
    "tangent_to_labels": "mosaic",
}
"""Modules that import torch, which takes seconds."""

__getattr__ = on_first_use(__name__, _WITH_TORCH)
