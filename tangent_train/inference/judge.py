"""Which of several directions is up, by how sure a network is of what it sees."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Self

import numpy as np
import torch

from datamodules.core.samples import world_rays
from tangent_train.geometry import CubeGrid, TangentGrid
from tangent_train.inference.predictor import (
    sees_rays,
    view_images,
    view_scores,
    views_per_forward,
)
from tangent_train.inference.views import InputImage, panorama_representation, resized
from tangent_train.rendering.representations.pinhole import PinholeRepresentation
from tangent_train.rendering.representations.views import PinholeViews
from tangent_train.rendering.upright.gravity import upright_rotation

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray
    from torch import Tensor, nn

    from datamodules.core.inputs import Input, Normalization
    from tangent_train.checkpoints.trained import TrainedNetwork

_AROUND = np.arange(4)  # faces of a cube: all but up and down
_FOV_DEG = 135.0  # the corners see ceiling and floor, where a wrong direction shows
_EXPONENT = 3.0  # fitted with one network to the real panoramas of one home, and to synthetic rooms
_LEAST_DOUBT = 1e-4


@dataclass(frozen=True)
class NetworkJudge:
    """Says how likely directions are to be up, by how sure a network is of what it sees.

    A network that was trained on upright images is surest of such. For every direction it gets
    views that stand upright by it. The doubt of a view is the mean probability that the best class
    of a pixel is wrong; a direction becomes more likely by doubt⁻³ of each view.

    Attributes:
        network: Maps images ``(n, C, h, w)``, normalized, to scores ``(n, K, h, w)``.
        inputs: Its inputs, see `Input`.
        normalization: Of RGB and depth.
        level: Level s: angular resolution of the views.
        views: Of an upright panorama, see `judging_views`.
        device: Where the network is.
    """

    network: nn.Module
    inputs: Sequence[Input]
    normalization: Normalization
    level: int
    views: PinholeViews
    device: torch.device | str = "cpu"

    @classmethod
    def of(cls, trained: TrainedNetwork, device: torch.device | str) -> Self:
        """The judge of a trained network, which is on the device."""
        seen = panorama_representation(trained) if sees_rays(trained.network) else None
        size = trained.size_multiple, trained.fixed_size
        views = judging_views(trained.network, seen, trained.level, *size)
        known = trained.network, trained.inputs, trained.normalization, trained.level
        return cls(*known, views, device)

    def __call__(self, image: Any, ups_xyz: NDArray[np.float64]) -> NDArray[np.float64]:
        """Log-likelihoods of directions, up to a constant they share.

        Args:
            image: A panorama: `InputImage`, or `Panorama` of a data set.
            ups_xyz: ``(n, 3)`` directions in its frame.

        Returns:
            ``(n,)``; all 0 of a network that gets the elevation of its pixels, which is told where
            up is and believes it.
        """
        if "elevation" in self.inputs:
            return np.zeros(len(ups_xyz))
        rows = min(image.rgb.shape[0], 2 ** (self.level + 1))
        seen = resized(InputImage(image.rgb, image.depth), (rows, 2 * rows))
        self.network.eval()
        doubts = np.array([self._doubts(seen, up) for up in ups_xyz])
        return -_EXPONENT * np.log(doubts + _LEAST_DOUBT).sum(axis=1)

    def _doubts(self, panorama: InputImage, up: NDArray[np.float64]) -> NDArray[np.float32]:
        """Mean doubt in each of the views."""
        image = replace(panorama, up=up)
        views = replace(self.views, grid=self.views.grid.with_rotation(upright_rotation(up)))
        rays = torch.from_numpy(world_rays(views, up)).to(self.device)

        def images(part: slice) -> Tensor:
            some = replace(views, faces=views.grid.face_indices(views.faces)[part])
            return view_images(image, some, self.inputs, self.normalization, self.device)

        per_forward = views_per_forward((views.grid.dim, views.grid.dim))
        of_sphere = rays if sees_rays(self.network) else None
        found = [
            1 - scores.softmax(dim=1).amax(dim=1).mean(dim=(1, 2))
            for _, scores in view_scores(self.network, images, len(rays), per_forward, of_sphere)
        ]
        return torch.cat(found).cpu().numpy()


def judging_views(
    network: nn.Module,
    representation: Any,
    level: int,
    size_multiple: int = 1,
    fixed_size: tuple[int, int] | None = None,
) -> PinholeViews:
    """The views by which a network judges.

    Four level ones of 135°; but all of its own for a network with cross-image attention, which
    knows the images of a whole sphere.

    Args:
        network: See `NetworkJudge`.
        representation: Of panoramas.
        level: Level s: a level view has the pixels of 90° at its angular resolution.
        size_multiple: Sides of its images must be multiples of this.
        fixed_size: Rows and columns of the least images that it takes, if they are fixed.
    """
    if sees_rays(network) and isinstance(representation, PinholeRepresentation):
        return PinholeViews(representation.grid)
    quarter = round(2 / TangentGrid(0, level).pitch)
    least = quarter if fixed_size is None else max(fixed_size)
    side = -(-least // size_multiple) * size_multiple
    beyond = 1 - 1 / math.tan(math.radians(_FOV_DEG / 2))
    return PinholeViews(CubeGrid(side, margin=round(side / 2 * beyond)), _AROUND)
