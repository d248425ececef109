"""Distances of whole panoramas and photos: views are aligned with each other, then blended."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tangent_train.checkpoints.kinds import Align, DepthKind
from tangent_train.geometry import ray_lengths
from tangent_train.heads.alignment import (
    AlignmentReport,
    align_views,
    lattice,
    sample_views,
    sphere_points,
)
from tangent_train.heads.distances import depth_of_output, distance_of, is_metric
from tangent_train.rendering import Blend
from tangent_train.rendering.mosaic import MeanMosaic
from tangent_train.rendering.representations.views import Views

_FARTHEST = 100.0
"""Multiples of the median beyond which relative depth is unknown, like sky: small errors of the
disparity change it without limit."""


class AlignedMosaic:
    """Distances along the rays of a panorama or photo.

    Views are blended in the logarithm of distance, or in disparity for networks that return it.

    Args:
        shape: ``(H, W)`` of the panorama or photo.
        kind: Kind of the network's output.
        blend: Blend of the views.
        align: See `alignment.align_views`.
        valid: ``(H, W)`` valid pixels of a partial panorama, at which views are compared; None if
            all are valid.
        camera_matrix: ``(3, 3)`` K of a photo; None for a panorama.

    Attributes:
        report: Facts about the alignment of the views, after `pixels` or `distances`.
    """

    report: AlignmentReport

    def __init__(
        self,
        shape: tuple[int, int],
        kind: DepthKind,
        blend: Blend,
        align: Align | None = None,
        *,
        valid: NDArray[np.bool_] | None = None,
        camera_matrix: NDArray[np.float64] | None = None,
    ) -> None:
        self._shape, self._kind, self._align = shape, kind, align
        self._blend: Blend = blend
        self._camera = camera_matrix
        points = sphere_points(shape) if camera_matrix is None else lattice(shape)
        if valid is not None:
            points = points[valid[points[:, 0], points[:, 1]]]
        self._points = points
        self._parts: list[tuple[Views, Tensor, Tensor]] = []

    def add(self, outputs: Tensor, views: Views) -> None:
        """Add some views, which together cover the image, once or several times.

        Args:
            outputs: Outputs of the network ``(n, 1, h, w)``.
            views: The views.
        """
        self._parts.append((views, outputs, torch.from_numpy(views.ray_lengths()).to(outputs)))

    def distances(self) -> Tensor:
        """Return distances ``(H, W)`` from the center along the rays, NaN where unknown.

        They are in meters, or for relative kinds in multiples of the median of known distances, of
        a photo of z-depth, by solid angle.

        Raises:
            SettingError: The views cannot be aligned in this way.
        """
        samples, depths = [], []
        for views, outputs, lengths in self._parts:
            depth, kind = depth_of_output(outputs, self._kind, lengths[:, None])
            depths.append(depth)
            array = depth[:, 0].cpu().numpy()
            samples.append(sample_views(array, views, self._shape, self._points))
        alignment = align_views(samples, kind, self._align)
        self.report = alignment.report
        mosaic = MeanMosaic(self._shape, self._blend, device=depths[0].device)
        count = 0
        for (views, _, lengths), depth in zip(self._parts, depths, strict=True):
            part = slice(count, count + len(views))
            mosaic.add(alignment.applied(depth, part, lengths), views)
            count = part.stop
        distance = distance_of(mosaic.values()[0], kind)
        if not is_metric(self._kind):
            distance = distance / self._median(distance)
            distance = distance.where(distance <= _FARTHEST, torch.nan)
            distance = distance / self._median(distance)  # without what was too far
        return distance

    def pixels(self) -> Tensor:
        """Return what users get: z-depth of a photo, distances of a panorama."""
        distance = self.distances()
        if self._camera is None:
            return distance
        return distance / torch.from_numpy(ray_lengths(self._camera, self._shape)).to(distance)

    @property
    def facts(self) -> Mapping[str, Any]:
        """Facts about the alignment, with numbers of views instead of lists."""
        report = asdict(self.report)
        return {name: len(v) if isinstance(v, tuple) else v for name, v in report.items()}

    def _median(self, distance: Tensor) -> float:
        """Return the median of known depth at points, by solid angle; 1 if all are unknown."""
        rows, columns = self._points.T
        values, lengths = distance.cpu().numpy()[rows, columns], np.ones(len(rows))
        if self._camera is not None:
            lengths = ray_lengths(self._camera, self._shape)[rows, columns]
        known = np.isfinite(values)
        if not known.any():
            return 1.0
        weights, values = lengths[known] ** -3.0, (values / lengths)[known]
        return float(np.quantile(values, 0.5, weights=weights, method="inverted_cdf"))
