"""Which of several directions is up, by how sure a network is of what it sees."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from tangent_train.geometry import CubeGrid, TangentGrid
from tangent_train.inference.predictor import image_scores, sees_rays, views_per_forward
from tangent_train.inference.views import InputImage, grid_set, panorama_representation, resized
from tangent_train.rendering.representations.views import PinholeViews
from tangent_train.rendering.upright.gravity import upright_rotation

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tangent_train.checkpoints.trained import TrainedNetwork

_AROUND = np.arange(4)  # faces of a cube: all but up and down
_FOV_DEG = 135.0  # the corners see ceiling and floor, where a wrong direction shows
_EXPONENT = 3.0  # fitted to the real panoramas of one home, and to synthetic rooms
_COUNTED = 20  # smaller views show the same
_LEAST_DOUBT = 1e-4


@dataclass(frozen=True)
class NetworkJudge:
    """Says how likely directions are to be up, by how sure a network is of what it sees.

    A network that was trained on upright images is surest of such. For every direction it gets
    views that stand upright by it: four level ones of 135°; but one with cross-image attention all
    of its own, of which it was more often right. The doubt of a view is the mean probability that
    the best class of a pixel is wrong; a direction becomes more likely by doubt⁻³ of each view, of
    up to 20.

    Attributes:
        trained: The network.
        device: Where it is.
    """

    trained: TrainedNetwork
    device: torch.device | str = "cpu"

    def __call__(self, image: Any, ups_xyz: NDArray[np.float64]) -> NDArray[np.float64]:
        """Log-likelihoods of directions, up to a constant they share.

        Args:
            image: A panorama: `InputImage`, or `Panorama` of a data set.
            ups_xyz: ``(n, 3)`` directions in its frame.

        Returns:
            ``(n,)``; all 0 of a network that gets the elevation of its pixels, which is told where
            up is and believes it.
        """
        if "elevation" in self.trained.inputs:
            return np.zeros(len(ups_xyz))
        rows = min(image.rgb.shape[0], 2 ** (self.trained.level + 1))
        seen = resized(InputImage(image.rgb, image.depth), (rows, 2 * rows))
        doubts = np.array([self._doubts(seen, up) for up in ups_xyz])
        counted = min(doubts.shape[1], _COUNTED)
        return -_EXPONENT * counted * np.log(doubts + _LEAST_DOUBT).mean(axis=1)

    def _doubts(self, panorama: InputImage, up: NDArray[np.float64]) -> NDArray[np.float32]:
        """Mean doubt in each of the views."""
        grid = self._views.grid.with_rotation(upright_rotation(up))
        views = grid_set(replace(panorama, up=up), grid, self._views.faces)
        per_forward = views_per_forward((grid.dim, grid.dim))
        found = [
            1 - scores.softmax(dim=1).amax(dim=1).mean(dim=(1, 2))
            for _, scores in image_scores(self.trained, views, per_forward, self.device)
        ]
        return torch.cat(found).cpu().numpy()

    @cached_property
    def _views(self) -> PinholeViews:
        """The views of an upright panorama."""
        trained = self.trained
        if sees_rays(trained.network):
            seen: Any = panorama_representation(trained)
            return PinholeViews(seen.grid)
        quarter = round(2 / TangentGrid(0, trained.level).pitch)  # pixels of 90° at its resolution
        least = quarter if trained.fixed_size is None else max(trained.fixed_size)
        side = -(-least // trained.size_multiple) * trained.size_multiple
        beyond = 1 - 1 / math.tan(math.radians(_FOV_DEG / 2))
        return PinholeViews(CubeGrid(side, margin=round(side / 2 * beyond)), _AROUND)
