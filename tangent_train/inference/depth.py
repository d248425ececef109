"""Depth of whole panoramas and photos: views are aligned with each other, then blended."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, get_args

import numpy as np
import torch

from tangent_train.checkpoints.distances import depth_of_output, distance_of, is_metric
from tangent_train.checkpoints.kinds import Align
from tangent_train.errors import SettingError
from tangent_train.geometry import ray_lengths
from tangent_train.inference.alignment import align as align_views
from tangent_train.inference.alignment import lattice, sample_views, sphere_points
from tangent_train.inference.engine import ViewPredictor
from tangent_train.rendering.checks import check_choice
from tangent_train.rendering.mosaic import MeanMosaic
from tangent_train.rendering.representations.views import Representation

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray
    from torch import Tensor

    from tangent_train.checkpoints.kinds import DepthKind
    from tangent_train.checkpoints.loaded import LoadedNetwork
    from tangent_train.inference.alignment import AlignmentReport
    from tangent_train.inference.images import InputImage
    from tangent_train.inference.representations import PanoramaViews, PhotoViews
    from tangent_train.rendering import Blend
    from tangent_train.rendering.representations.views import Views

_FARTHEST = 100.0
"""Multiples of the median beyond which relative depth is unknown, like sky: small errors of the
disparity change it without limit."""


@dataclass(frozen=True)
class DistanceMap:
    """Distances from the center along the rays of a panorama or photo.

    Attributes:
        distance: ``(H, W)`` float32, NaN where unknown: meters; or for relative kinds multiples of
            the median of known distances, of a photo of z-depth, by solid angle.
        report: Facts about the alignment of the views.
    """

    distance: Tensor
    report: AlignmentReport

    def depth(self, camera_matrix: NDArray[np.float64] | None) -> Tensor:
        """Return what users get: z-depth of a photo, distance of a panorama.

        Args:
            camera_matrix: ``(3, 3)`` K of the photo; None for a panorama.
        """
        if camera_matrix is None:
            return self.distance
        lengths = ray_lengths(camera_matrix, self.distance.shape)
        return self.distance / torch.from_numpy(lengths).to(self.distance)


def combine_depth(
    outputs: Sequence[tuple[Views, Tensor]],
    shape: tuple[int, int],
    kind: DepthKind,
    blend: Blend,
    align: Align | None = None,
    *,
    valid: NDArray[np.bool_] | None = None,
    camera_matrix: NDArray[np.float64] | None = None,
) -> DistanceMap:
    """Align the depth of all views of a panorama or photo, and blend it.

    Views are blended in the logarithm of distance, or in disparity for networks that return it.

    Args:
        outputs: Views that cover the image, once or several times, and the network's output for
            them, ``(n, 1, h, w)``.
        shape: ``(H, W)`` of the panorama or photo.
        kind: Kind of the output.
        blend: Blend of the views.
        align: See `alignment.align`.
        valid: ``(H, W)`` valid pixels of a partial panorama, at which views are compared; None if
            all are valid.
        camera_matrix: ``(3, 3)`` K of a photo; None for a panorama.

    Raises:
        SettingError: The views cannot be aligned in this way.
    """
    points = sphere_points(shape) if camera_matrix is None else lattice(shape)
    if valid is not None:
        points = points[valid[points[:, 0], points[:, 1]]]
    parts, samples, count = [], [], 0
    for views, raw in outputs:
        lengths = torch.from_numpy(views.ray_lengths()).to(raw)
        depth, depth_kind = depth_of_output(raw, kind, lengths[:, None])
        samples.append(sample_views(depth[:, 0].cpu().numpy(), views, shape, points))
        parts.append((views, depth, slice(count, count + len(views)), lengths))
        count += len(views)
    alignment = align_views(samples, depth_kind, align)
    mosaic = MeanMosaic(shape, blend, device=outputs[0][1].device)
    for views, depth, numbers, lengths in parts:
        mosaic.add(alignment.applied(depth, numbers, lengths), views)
    distance = distance_of(mosaic.values()[0], depth_kind)
    if not is_metric(kind):
        distance = distance / _median(distance, points, camera_matrix)
        distance = distance.where(distance <= _FARTHEST, torch.nan)
        distance = distance / _median(distance, points, camera_matrix)  # without what was too far
    return DistanceMap(distance, alignment.report)


def check_align(setting: str, align: Align | None, representation: Any) -> None:
    """Refuse to align a panorama's only view, such as the whole equirectangular image.

    Args:
        setting: Name of the setting, for the message.
        align: Its value.
        representation: Views of panoramas; None or others for photos, which may have one crop.

    Raises:
        SettingError: The value is unknown; or there is only one view, and a correction is given.
    """
    check_choice(setting, align or "none", get_args(Align))
    if align in (None, "none") or not isinstance(representation, Representation):
        return
    if sum(map(len, representation.view_sets())) == 1:
        expected = "none: the panorama is one view, with nothing to align it to"
        raise SettingError(setting, found=align, expected=expected)


class DepthPredictor(ViewPredictor):
    """Predicts the depth of whole panoramas or photos.

    Args:
        trained: See `ViewPredictor`; a depth network.
        view_sets: Selects the views of an image.
        device: See `ViewPredictor`.
        view_batch_size: See `ViewPredictor`.
        align: See `combine_depth`.

    Raises:
        SettingError: See `ViewPredictor`; or the views cannot be aligned in this way.
    """

    def __init__(
        self,
        trained: LoadedNetwork,
        view_sets: PanoramaViews | PhotoViews,
        device: str = "cpu",
        view_batch_size: int | None = None,
        align: Align | None = None,
    ) -> None:
        check_align("align", align, getattr(view_sets, "representation", None))
        super().__init__(trained, view_sets, device, view_batch_size)
        self._kind: Any = trained.depth_kind
        self._align = align

    @torch.no_grad()
    def predict(
        self, image: InputImage, progress: Callable[[float], object] = lambda share: None
    ) -> DistanceMap:
        """Predict the distances of one image at its own resolution.

        Args:
            image: A panorama or photo.
            progress: Called with the share of the image that was predicted since the last call.

        Raises:
            SettingError: The views cannot be aligned in this way.
        """
        return combine_depth(
            list(self._scored(self._sets(image), progress)),
            image.shape,
            self._kind,
            self._view_sets.blend,
            self._align,
            valid=image.valid,
            camera_matrix=image.camera_matrix,
        )


def _median(
    distance: Tensor, points: NDArray[np.int64], camera_matrix: NDArray[np.float64] | None
) -> float:
    """Return the median of known depth at points, by solid angle; 1 if all are unknown."""
    rows, columns = points.T
    values, lengths = distance.cpu().numpy()[rows, columns], np.ones(len(points))
    if camera_matrix is not None:
        lengths = ray_lengths(camera_matrix, distance.shape)[rows, columns]
    known = np.isfinite(values)
    if not known.any():
        return 1.0
    weights, values = lengths[known] ** -3.0, (values / lengths)[known]
    return float(np.quantile(values, 0.5, weights=weights, method="inverted_cdf"))
