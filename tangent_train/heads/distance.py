"""Head for distances: the distance from the center at every pixel."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from pydantic import Field, validate_call
from torch import Tensor

from datamodules.core.depth import STEPS_PER_M
from datamodules.core.label_map import DISTANCE
from tangent_train.errors import SettingError, of_extra
from tangent_train.files import write_bytes
from tangent_train.geometry import equirect_to_lonlat, lonlat_to_xyz, to_right_handed
from tangent_train.geometry.normals import equirect_normals, pinhole_normals
from tangent_train.heads import alignment as views
from tangent_train.heads import pictures
from tangent_train.heads.base import RGB, Head, PredictedImage, Scores
from tangent_train.heads.classes import exact
from tangent_train.io.exr import write_exr
from tangent_train.io.pixel_files import most_depth_m, read_depth_m, write_depth_m, write_pixels
from tangent_train.kinds import Align, DepthKind, depth_channels
from tangent_train.metrics import depth as metrics
from tangent_train.metrics.image_sums import Sums, as_sums, means_of_sums
from tangent_train.metrics.scores import (
    ScoreColumn,
    by_solid_angle,
    sphere_columns,
    with_solid_angle,
)
from tangent_train.rendering import Blend

if TYPE_CHECKING:
    from tangent_train.metrics.collected import DepthMetric

DepthLoss = Literal["log_l1", "scale_invariant"]
"""Loss of predicted distances, see `log_error_sum`."""

_LEAST = 1e-3
"""Smallest depth, in meters, or disparity whose logarithm is taken in the loss."""

_WORSE = 1.01
"""Quotient of the steps after and before an alignment above which views agree less."""

_SAMPLES = 2**16
"""Pixels whose median is that of an image."""

POSE_UNIT = "unit of poses"
"""Unit of distances whose scale is that of known poses."""

_UNITS = {
    "m": "depth in meters",
    "relative": "relative: median distance 1",
    POSE_UNIT: "depth in the unit of the poses",
}

_ROWS = {
    "known": "known pixels, % of the solid angle",
    "too_far": "too far for 16 bits, unknown in depth files, %",
    "nearest": "nearest{unit}",
    "median": "median{unit}",
    "farthest": "farthest{unit}",
    "step_before": "median step between views before alignment, %",
    "step_after": "median step between views after alignment, %",
    "isolated": "views without overlap",
    "rotation_error_deg": "error of the network's own rotations, °",
}
"""Rows of the table, by name in the summary; shares are in percent."""


class DistanceHead(Head):
    """One distance for every pixel, or depth of another kind, see `DepthKind`.

    The loss is that of the logarithm. The views of a panorama are aligned with each other and
    blended. Scores are means over the images. Predicted pixels are distances from the center in
    panoramas and z-depth in photos, float32, NaN where unknown.

    Args:
        class_names: Not used.
        depth_kind: Kind of the network's output; None for ``log_distance``.
        loss: Kind of loss, see `log_error_sum`.
        scale_invariance: λ of the loss `scale_invariant`.
        align: Alignment of the views of a panorama with each other, see `heads.alignment`; None for
            the usual one of `depth_kind`.
        alignment_in: See `DepthProtocol`; None for the quantity in which the network predicts.
        depth_format: Suffix of the depth files without dot: png, npy or exr; None for png.
        depth_scale: Units per meter in PNG files.
        points: Largest number of points of an image; None for 500 000.
        **protocol: Further settings of `DepthProtocol`. Pixels beyond its limits are ignored in
            training too.
    """

    kind: ClassVar[str] = DISTANCE
    labels: ClassVar[str] = DISTANCE
    columns: ClassVar[Mapping[str, ScoreColumn]] = with_solid_angle(
        {
            "absrel": ScoreColumn("AbsRel", "", better="lower"),
            "delta1": ScoreColumn("δ1"),
            "rmse": ScoreColumn("RMSE", "m", better="lower"),
            "mae": ScoreColumn("MAE", "m", better="lower", is_main=False),
            "sqrel": ScoreColumn("SqRel", "m", better="lower", is_main=False),
            "rmse_log": ScoreColumn("RMSElog", "", better="lower", is_main=False),
            "delta2": ScoreColumn("δ2", is_main=False),
            "delta3": ScoreColumn("δ3", is_main=False),
            "missing": ScoreColumn("missing", better="lower", is_main=False),
        }
    ) | sphere_columns("AbsRel", "", better="lower", distance="median change of distance")
    main_score: ClassVar[str] = "absrel"
    predict_settings = MappingProxyType(
        {"align": "", "depth_format": "depth", "depth_scale": "depth", "points": "points"}
    )
    num_outputs = 1
    summary: ClassVar[str] = "depth"
    unknown: ClassVar[float] = math.nan
    waits: ClassVar[bool] = True
    summary_columns = ("unit", *_ROWS)

    @validate_call
    def __init__(
        self,
        class_names: Sequence[str] = (),
        depth_kind: DepthKind | None = None,
        loss: DepthLoss = "log_l1",
        scale_invariance: float = 0.5,
        align: Align | None = None,
        alignment_in: metrics.Quantity | None = None,
        depth_format: str | None = None,
        depth_scale: Annotated[float, Field(gt=0)] = 1000.0,
        points: int | None = None,
        **protocol: Any,
    ) -> None:
        super().__init__()
        self.depth_kind: DepthKind = depth_kind or "log_distance"
        usual: metrics.Quantity = "disparity" if views.is_disparity(self.depth_kind) else "distance"
        self.protocol = metrics.DepthProtocol(alignment_in=alignment_in or usual, **protocol)
        self.loss: DepthLoss = loss
        self.scale_invariance, self.align = scale_invariance, align
        self.is_metric = views.is_metric(self.depth_kind)
        suffix = f".{depth_format or 'png'}"
        self._units_per_m, self._most = depth_scale, most_depth_m(suffix, depth_scale)
        self._points = 500_000 if points is None else points
        more = {"normals": ".exr", "points": ".ply"}
        self.suffixes = {"depth": suffix, "color": ".png", **more}
        self._views_aligned: views.AlignedMosaic | None = None

    # Training

    def truth(self, labels: Tensor) -> Float[Tensor, "*shape"]:
        """Return true distances in meters; NaN where they are unknown or beyond the limits.

        Args:
            labels: Distances in steps of 1/512 m, 0 where unknown.
        """
        return self.protocol.limited(labels.float() / STEPS_PER_M)

    def targets(self, truth: Tensor, ray_lengths: Tensor) -> Tensor:
        """Return the correct output, see `Head`."""
        return views.from_distance(truth, self.depth_kind, ray_lengths)

    def loss_sum(self, outputs: Tensor, targets: Tensor) -> Tensor:
        """Return the loss of outputs ``(n, 1, h, w)``, given the correct ones ``(n, h, w)``."""
        return log_error_sum(self.errors(outputs, targets), self.loss, self.scale_invariance)

    def errors(
        self, outputs: Float[Tensor, "images 1 height width"], targets: Tensor
    ) -> Float[Tensor, "images height width"]:
        """Return the errors of the logarithm of the network's depth, or disparity.

        Relative outputs are first scaled and shifted, see `scaled_and_shifted`; `relative_z` is
        only scaled, to a mean error of 0.

        Args:
            outputs: Outputs of the network.
            targets: The correct outputs ``(n, h, w)``; NaN where unknown.
        """
        values = outputs[:, 0].to(targets.dtype)  # float32 in half-precision training
        if self.depth_kind == "log_distance":
            return values - targets
        if not self.is_metric and self.depth_kind != "relative_z":
            values = metrics.scaled_and_shifted(values, targets)
        errors = values.clamp(min=_LEAST).log() - targets.log()
        if self.depth_kind == "relative_z":
            errors = errors - errors.nanmean(dim=(-2, -1), keepdim=True)
        return errors

    def loss_norm(self, targets: Tensor) -> Tensor:
        """Return the number of pixels whose distance is known."""
        return (~targets.isnan()).sum().float()

    # Scores

    def build_metric(self) -> DepthMetric:
        """Build the metric, which keeps the sums of the errors of each image.

        Raises:
            SettingError: The predictions have no scale, and are not aligned with the truth.
        """
        if self.protocol.alignment == "none" and not self.is_metric:
            found = f"none, for a network that predicts {self.depth_kind}"
            expected = "median, scale or affine: the scale of its distances is unknown"
            raise SettingError("task.head.alignment", found=found, expected=expected)
        from tangent_train.metrics.collected import DepthMetric  # seconds to import

        return DepthMetric()

    def scores(self, result: NDArray[np.float64]) -> Scores:
        """Return means over images; for panoramas, also by solid angle, latitude and region.

        Args:
            result: Sums ``(images, 13, 10)``, see `error_sums`.
        """
        bands = map(metrics.mean_depth_scores, result[:, metrics.BANDS].swapaxes(0, 1))
        means = means_of_sums(self.image_sums(result))
        return Scores(means, bands=list(bands) if result[:, 1].any() else ())

    def image_sums(self, result: NDArray[np.float64]) -> Sums:
        """Return the scores of each image."""
        pixels, angles = (metrics.depth_scores(result[:, weighting]) for weighting in (0, 1))
        if not result[:, 1].any():
            return as_sums(pixels)
        of_sphere = metrics.sphere_scores(result[:, metrics.SPHERE])
        return as_sums(pixels | by_solid_angle(angles) | of_sphere)

    def agreement(self, first: PredictedImage, other: PredictedImage) -> dict[str, float]:
        """Return the median of ``|d' / d − 1|``; d' is aligned with d as it is with the truth."""
        before, after = (torch.from_numpy(image.pixels).double() for image in (first, other))
        changes = (self.comparable(after, before) / before - 1).abs().numpy()
        angles = np.array(first.solid_angles)
        return {"distance": np.nanquantile(changes, 0.5, weights=angles, method="inverted_cdf")}

    @property
    def facts(self) -> dict[str, str]:
        """Errors are those of the pixels of an image, averaged over the images.

        The alignment of views is known after an evaluation on panoramas.
        """
        facts = {"weighting": "pixels, then images", **self.protocol.facts}
        mosaic = self._views_aligned
        return facts if mosaic is None else facts | {"views_aligned": mosaic.facts["mode"]}

    def comparable(
        self, prediction: Tensor, truth: Tensor, ray_lengths: Tensor | None = None
    ) -> Tensor:
        """Return distances aligned with the true ones; crops of a photo have separate scales."""
        if ray_lengths is None:
            return self.protocol.aligned(prediction, truth)
        crops = zip(prediction, truth, ray_lengths, strict=True)
        return torch.stack([self.protocol.aligned(*crop) for crop in crops])

    # From views to a panorama

    def mosaic(
        self,
        shape: tuple[int, int],
        blend: Blend,
        *,
        valid: NDArray[np.bool_] | None = None,
        camera_matrix: NDArray[np.float64] | None = None,
        **_: Any,
    ) -> views.AlignedMosaic:
        """Return a mosaic that keeps all views until they are aligned."""
        given = shape, self.depth_kind, blend, self.align
        mosaic = views.AlignedMosaic(*given, valid=valid, camera_matrix=camera_matrix)
        self._views_aligned = mosaic
        return mosaic

    def crop_pixels(self, outputs: Tensor, ray_lengths: Tensor) -> Tensor:
        """Return distances along the rays of single crops."""
        lengths = ray_lengths[:, None]
        depth = outputs[:, : depth_channels(self.depth_kind)]  # without confidence
        values, kind = views.depth_of_output(depth, self.depth_kind, lengths)
        return views.distance_of(views.along_rays(values, kind, lengths), kind)[:, 0]

    # Pictures and files

    def panel(self, rgb: RGB, truth: NDArray[Any], prediction: NDArray[Any]) -> RGB:
        """Draw input, true and predicted distance, and error in a 2 × 2 grid."""
        return pictures.distance_panel(rgb, truth, prediction)

    def error(self, prediction: Tensor, truth: Tensor) -> tuple[float, str]:
        """Return AbsRel of one image, also as text; 0 and "" without known distances."""
        sums = metrics.error_sums(prediction, truth)[:1].cpu().numpy()
        absrel = metrics.mean_depth_scores(sums)["absrel"]
        return (0.0, "") if np.isnan(absrel) else (float(absrel), f"AbsRel {absrel:.3g}")

    def write(self, files: Mapping[str, Path], predicted: PredictedImage) -> None:
        """Write depth, a colored picture, normals and points."""
        super().write(files, predicted)
        if not {"normals", "points"}.intersection(files):
            return
        normals = np.nan_to_num(normals_of(predicted))
        if "normals" in files:
            write_exr(files["normals"], normals)
            picture = np.rint((normals + 1) * 127.5 * normals.any(axis=-1, keepdims=True))
            write_pixels(files["normals"].with_suffix(".png"), picture.astype(np.uint8))
        if "points" in files:
            from trimesh import Trimesh  # half a second

            pixels = spread_pixels(predicted, self._points)
            points, colors = points_of(predicted, pixels)
            given = {"vertex_normals": normals[tuple(pixels)], "vertex_colors": colors}
            cloud = Trimesh(points.astype(np.float32), process=False, **given)
            write_bytes(files["points"], cloud.export(file_type="ply", vertex_normal=True))

    def file_kinds(self, write: Sequence[str] | None) -> Sequence[str]:
        """Return the kinds of output of the setting `write`, see `Head`.

        Raises:
            SettingError: A package for a format is missing too.
        """
        kinds = super().file_kinds(write)
        if ".exr" in map(self.suffixes.get, kinds):
            with of_extra("exr", "write and depth_format"):
                import OpenEXR  # noqa: F401
        return kinds

    def write_source(self, file: Path, pixels: NDArray[Any]) -> None:
        """Write depth."""
        write_depth_m(file, pixels, self._units_per_m)

    def read(self, file: Path) -> NDArray[Any]:
        """Read depth."""
        depth = read_depth_m(file, self._units_per_m)
        return np.where(depth > 0, depth, np.float32(np.nan))

    def paint(self, kind: str, rgb: RGB, pixels: NDArray[Any], limits: Any = None) -> RGB:
        """Color depth."""
        return pictures.colorize_distance(pixels, limits)

    def limits(self, summaries: Sequence[Any]) -> tuple[float, float]:
        """Return the range of the colors of all frames of a video."""
        ranges = [colors for summary in summaries if (colors := summary.get("colors"))]
        near, far = zip(*ranges, strict=True) if ranges else ([1.0], [2.0])
        return min(near), max(far)

    def picture(self, kind: str, predicted: PredictedImage) -> RGB:
        """Return the colored depth with a bar of its colors."""
        limits, unit = pictures.distance_limits(predicted.pixels), self._unit(predicted)
        painted = self.paint(kind, predicted.image.rgb, predicted.pixels, limits)
        return pictures.with_distance_legend(painted, limits, unit)

    def _unit(self, predicted: PredictedImage) -> str:
        return str(predicted.facts.get("unit", "m" if self.is_metric else "relative"))

    def report_maps(self, predicted: PredictedImage) -> dict[str, Any]:
        """Return distances and their unit; evaluations align them with true ones, in meters."""
        unit = predicted.facts.get(self.summary, {}).get("unit", "m")
        return {**super().report_maps(predicted), "unit": unit}

    def summarize(self, predicted: PredictedImage, is_counted: NDArray[np.bool_]) -> Any:
        """Return unit, shares of the solid angle, distances, range of the colors, alignment."""
        depth, angles = predicted.pixels, predicted.solid_angles
        total = np.sum(angles, where=is_counted) or 1
        known, too_far = (
            np.sum(angles, where=mask) / total for mask in (np.isfinite(depth), depth > self._most)
        )
        facts = {**predicted.facts, "known": known, "too_far": too_far}
        summary: dict[str, Any] = {"unit": self._unit(predicted)}
        if known:
            median = np.median(depth[tuple(spread_pixels(predicted, _SAMPLES))])
            facts |= {"nearest": np.nanmin(depth), "median": median, "farthest": np.nanmax(depth)}
            summary["colors"] = [float(f"{limit:.4g}") for limit in pictures.distance_limits(depth)]
        rounded = {
            name: float(f"{value:.4g}") if isinstance(value, float | np.floating) else value
            for name, value in facts.items()
        }
        return rounded | summary

    def table(self, summaries: Sequence[Any]) -> tuple[str, Sequence[str], list[list[str]]]:
        """Return the means of the summaries over the images."""
        rows, units = [], {of["unit"] for of in summaries}
        unit = ", m" * (units == {"m"})
        for name, title in _ROWS.items():
            values = [value for of in summaries if (value := of.get(name)) is not None]
            if any(values) or (name == "known" and values):
                mean = np.mean(values) * (100 if "%" in title else 1)
                rows.append([title.format(unit=unit), f"{mean:.3g}"])
        steps = [(of.get("step_before"), of.get("step_after")) for of in summaries]
        if worse := sum(None not in step and step[1] > _WORSE * step[0] for step in steps):
            rows.append(
                ["images whose views agree less than before: try another align", str(worse)]
            )
        kind = ", ".join(text for unit, text in _UNITS.items() if unit in units)
        return f"Mean over the images ({kind})", ["quantity", "mean"], rows


def log_error_sum(
    errors: Float[Tensor, "images height width"], kind: DepthLoss, scale_invariance: float
) -> Tensor:
    """Sum the loss of logarithmic errors e = ln d − ln g; divide it by the number of known pixels.

    * `log_l1`: ``Σ |e|``.
    * `scale_invariant`: ``Σᵢ (Σ e² − λ (Σ e)² / nᵢ)`` over the images i of the network with nᵢ
      known pixels each (Eigen, Puhrsch and Fergus, NeurIPS 2014, equation 4). A chunk contains
      whole images, so that the sum is exact for all divisions of a step.

    Args:
        errors: Errors; NaN where the true distance is unknown.
        kind: Kind of the loss.
        scale_invariance: λ from 0 to 1: 1 ignores a common scale of each image.
    """
    known = ~errors.isnan()
    values = exact(errors).where(known, 0)
    if kind == "log_l1":
        return values.abs().sum()
    counts = known.flatten(1).sum(dim=1).clamp(min=1)
    common = values.flatten(1).sum(dim=1).square() / counts
    return values.square().sum() - scale_invariance * common.sum()


def spread_pixels(predicted: PredictedImage, count: int) -> NDArray[np.intp]:
    """Return known pixels, evenly spread over the solid angle that they cover.

    Row by row, a pixel is taken each time the solid angle has grown by a `count`-th of the sum
    (systematic sampling).

    Args:
        predicted: Image with its depth.
        count: Number of pixels, at most.

    Returns:
        ``(2, n)`` rows and columns of the depth map.
    """
    grown = np.where(np.isfinite(predicted.pixels), predicted.solid_angles, 0).ravel()
    np.cumsum(grown, out=grown)  # in place, which saves memory
    grown *= count / (grown[-1] or 1)
    np.floor(grown, out=grown)
    chosen = np.flatnonzero(np.concatenate([grown[:1] > 0, grown[1:] > grown[:-1]]))
    return np.stack(np.unravel_index(chosen, predicted.pixels.shape))


def points_of(
    predicted: PredictedImage, pixels: NDArray[np.intp]
) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Return ``(n, 3)`` points and their RGB colors.

    Args:
        predicted: Image with its depth.
        pixels: Rows and columns, see `spread_pixels`.

    Returns:
        Points in right-handed axes, as other programs expect: of panoramas x ahead (the middle of
        the panorama), y to the left, z up; of photos x to the right, y down, z ahead.
    """
    image, depth, (rows, columns) = predicted.image, predicted.pixels[tuple(pixels)], pixels
    if image.area is not None:
        of_rows, of_columns = image.area.places()
        rows, columns = of_rows[rows], of_columns[columns]
        lonlat_rad = equirect_to_lonlat(np.stack([columns, rows], axis=-1), image.shape)
        rays = to_right_handed(lonlat_to_xyz(lonlat_rad))
    else:
        rays = np.stack([columns, rows, np.ones_like(rows)], axis=-1)
        rays = rays @ np.linalg.inv(np.asarray(image.camera_matrix)).T
    return rays * depth[:, None].astype(np.float64), image.rgb[rows, columns]


def normals_of(predicted: PredictedImage) -> NDArray[np.float32]:
    """Return the normals ``(h, w, 3)`` of the surfaces, in the axes of `points_of`.

    They are unit vectors that face the camera; NaN where unknown, see `equirect_normals`.
    """
    image, depth, _ = predicted
    if image.area is None:
        return pinhole_normals(depth, np.asarray(image.camera_matrix)).astype(np.float32)
    whole = equirect_normals(image.area.place(depth))
    return to_right_handed(image.cut(whole)).astype(np.float32)
