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
from tangent_train.inference.views import InputImage, resized
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
_WEIGHT = 12.0  # fitted with one network to the real panoramas of one home, and to synthetic rooms
_LEAST_DOUBT = 1e-4


@dataclass(frozen=True)
class NetworkJudge:
    """Says how likely directions are to be up, by how sure a network is of what it sees.

    A network that was trained on upright images is surest of such. For every direction it gets
    four level views of 135° that stand upright by it; the four doubts, the mean probability that
    the best class of a pixel is wrong, are averaged as logarithms, so that no view decides alone.

    Attributes:
        network: Maps images ``(n, C, h, w)``, normalized, to scores ``(n, K, h, w)``.
        inputs: Its inputs, see `Input`.
        normalization: Of RGB and depth.
        level: Level s: a view has the pixels of 90° at its angular resolution.
        size_multiple: Sides of its images must be multiples of this.
        fixed_size: Rows and columns of the least images that it takes, if they are fixed.
        device: Where the network is.
    """

    network: nn.Module
    inputs: Sequence[Input]
    normalization: Normalization
    level: int
    size_multiple: int = 1
    fixed_size: tuple[int, int] | None = None
    device: torch.device | str = "cpu"

    @classmethod
    def of(cls, trained: TrainedNetwork, device: torch.device | str) -> Self:
        """The judge of a trained network, which is on the device."""
        known = trained.network, trained.inputs, trained.normalization, trained.level
        return cls(*known, trained.size_multiple, trained.fixed_size, device)

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
        doubts = np.array([self._doubts(replace(seen, up=up)) for up in ups_xyz])
        return -_WEIGHT * np.log(doubts + _LEAST_DOUBT).mean(axis=1)

    def _doubts(self, image: InputImage) -> NDArray[np.float32]:
        """Mean doubt in each of the four views."""
        grid = self._grid(image.up)
        faces = PinholeViews(grid, _AROUND)
        rays = torch.from_numpy(world_rays(faces, image.up)).to(self.device)

        def images(part: slice) -> Tensor:
            views = PinholeViews(grid, _AROUND[part])
            return view_images(image, views, self.inputs, self.normalization, self.device)

        per_forward = views_per_forward((grid.dim, grid.dim))
        of_sphere = rays if sees_rays(self.network) else None
        found = [
            1 - scores.softmax(dim=1).amax(dim=1).mean(dim=(1, 2))
            for _, scores in view_scores(self.network, images, len(_AROUND), per_forward, of_sphere)
        ]
        return torch.cat(found).cpu().numpy()

    def _grid(self, up: Any) -> CubeGrid:
        """A cube whose faces overlap, of a size that the network takes."""
        quarter = round(2 / TangentGrid(0, self.level).pitch)
        least = quarter if self.fixed_size is None else max(self.fixed_size)
        side = -(-least // self.size_multiple) * self.size_multiple
        beyond = 1 - 1 / math.tan(math.radians(_FOV_DEG / 2))
        return CubeGrid(side, upright_rotation(up), margin=round(side / 2 * beyond))
