"""Evidence for the direction of up in a panorama, from the confidence of a network."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from models.distortion_aware import make_ordinary
from tangent_train.geometry import TangentGrid
from tangent_train.inference.engine import (
    RenderedViews,
    sees_rays,
    view_scores,
    views_per_forward,
)
from tangent_train.inference.images import InputImage
from tangent_train.inference.views import PanoramaViews
from tangent_train.orientation.gravity import upright_rotation
from tangent_train.rendering import CubemapRepresentation

if TYPE_CHECKING:
    from numpy.typing import NDArray
    from torch import nn

    from tangent_train.checkpoints.loaded import LoadedNetwork
    from tangent_train.rendering.representations.views import Representation

_FOV_DEG = 135.0  # the corners show ceiling and floor, which reveal a wrong direction
_EXPONENT = 3.0  # fitted to real panoramas of one home, and to synthetic rooms
_COUNTED = 20  # more, smaller views do not add evidence
_LEAST = 1e-4


@dataclass(frozen=True)
class UpLikelihood:
    """Estimates how likely directions are to be up, from the confidence of a network.

    A network that was trained on upright images is most confident on upright images. For each
    direction it gets four horizontal views of 135° that are upright for that direction. A network
    with cross-image attention gets all views of its representation, with which it was more often
    right, and a network of whole spheres gets its view. The uncertainty of a view is the mean of 1
    − confidence over its pixels. The likelihood of a direction is the product of uncertainty⁻³ over
    up to 20 views.

    Attributes:
        loaded: The network.
        device: Device of the network.
    """

    loaded: LoadedNetwork
    device: torch.device | str = "cpu"

    def __call__(self, image: Any, ups_xyz: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return log-likelihoods of directions, up to a common constant.

        Args:
            image: A panorama: an `InputImage`, or a `Panorama` of a data set.
            ups_xyz: ``(n, 3)`` directions in its frame.

        Returns:
            ``(n,)`` log-likelihoods. All are 0 for a network with elevation as an input, because
            that depends on the direction itself.
        """
        if "elevation" in self.loaded.inputs:
            return np.zeros(len(ups_xyz))
        rows = min(image.rgb.shape[0], 2 ** (self.loaded.level + 1))
        panorama = InputImage(image.rgb, image.depth)
        rendered = RenderedViews(self.loaded, panorama, (rows, 2 * rows), self.device)
        uncertainties = np.array([self._uncertainties(rendered, up) for up in ups_xyz])
        counted = min(uncertainties.shape[1], _COUNTED)
        return -_EXPONENT * counted * np.log(uncertainties + _LEAST).mean(axis=1)

    def _uncertainties(
        self, rendered: RenderedViews, up: NDArray[np.float64]
    ) -> NDArray[np.float32]:
        """Return the mean uncertainty of each view."""
        network: Any = self._network
        representation, rays = self._representation, None
        per_forward = views_per_forward(representation.image_size)
        views = representation.with_rotation(upright_rotation(up)).view_sets()[0]
        if not self._takes_own_views:
            views = views[:4]  # of a cube, without up and down
        if sees_rays(network):
            network = partial(network, view_batch_size=per_forward)
            rays = torch.from_numpy(representation.view_sets()[0].rays()).to(self.device)
        found = [
            1 - scores.softmax(dim=1).amax(dim=1).mean(dim=(1, 2))
            for _, scores in view_scores(network, rendered.of(views), len(views), per_forward, rays)
        ]
        return torch.cat(found).cpu().numpy()

    @cached_property
    def _network(self) -> nn.Module:
        """The network for pinhole images."""
        return make_ordinary(self.loaded.network)

    @property
    def _takes_own_views(self) -> bool:
        return self.loaded.is_spherical or sees_rays(self.loaded.network)

    @cached_property
    def _representation(self) -> Representation:
        """The views of an upright panorama."""
        loaded = self.loaded
        if self._takes_own_views:
            return PanoramaViews(loaded).representation
        quarter = round(2 / TangentGrid(0, loaded.level).pitch)  # pixels of 90° at its level
        least = quarter if loaded.fixed_size is None else max(loaded.fixed_size)
        side = -(-least // loaded.size_multiple) * loaded.size_multiple
        beyond = 1 - 1 / math.tan(math.radians(_FOV_DEG / 2))
        return CubemapRepresentation(loaded.level, side, margin=round(side / 2 * beyond))
