"""Write predicted depth: depth maps, colored pictures, point clouds and statistics."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from tangent_train.errors import SettingError, at_least, of_extra
from tangent_train.files import write_bytes
from tangent_train.geometry import FLIP_Y, equirect_to_lonlat, lonlat_to_xyz
from tangent_train.io.pixel_files import most_depth_m, read_depth_m, write_depth_m, write_pixels
from tangent_train.results.pictures import colorize_distance, distance_limits, distance_picture
from tangent_train.results.predictions import Entry, ImageResults, PredictedImage, solid_angles
from tangent_train.results.tables import Table

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from tangent_train.results.predictions import Painter

_POINTS = 500_000
_WORSE = 1.01
"""Quotient of the steps after and before an alignment above which views agree less."""

_SAMPLES = 2**16
"""Pixels whose median is that of an image."""

_ROWS = {
    "known": "known pixels, % of the solid angle",
    "too_far": "too far for 16 bits, unknown in depth files, %",
    "nearest": "nearest{unit}",
    "median": "median{unit}",
    "farthest": "farthest{unit}",
    "step_before": "median step between views before alignment, %",
    "step_after": "median step between views after alignment, %",
    "isolated": "views without overlap",
}
"""Rows of the table, by name in the summary; shares are in percent."""


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
    grown = np.where(np.isfinite(predicted.pixels), solid_angles(predicted), 0).ravel()
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
        rays = lonlat_to_xyz(lonlat_rad) @ FLIP_Y
    else:
        rays = np.stack([columns, rows, np.ones_like(rows)], axis=-1)
        rays = rays @ np.linalg.inv(np.asarray(image.camera_matrix)).T
    return rays * depth[:, None].astype(np.float64), image.rgb[rows, columns]


class DepthResults(ImageResults):
    """Results of a network that predicts depth; see `ImageResults`.

    Pixels are distances from the center in panoramas and z-depth in photos, float32, NaN where
    unknown.

    Args:
        is_metric: True for meters; False for distances that are known up to a factor.
        depth_format: Suffix of the depth files without dot: png, npy or exr; None for png.
        depth_scale: Units per meter in PNG files.
        points: Number of points of an image, at most; None for 500 000.

    Raises:
        SettingError: A setting is invalid, or a package for the format is missing.
    """

    summary = "depth"
    unknown = math.nan
    columns = ("unit", *_ROWS)

    def __init__(
        self, *, is_metric: bool, depth_format: str | None, depth_scale: float, points: int | None
    ) -> None:
        suffix = f".{depth_format or 'png'}"
        if suffix == ".exr":
            with of_extra("exr", "depth_format"):
                import OpenEXR  # noqa: F401
        if not 0 < depth_scale < math.inf:
            raise SettingError("depth_scale", found=depth_scale, expected="more than 0")
        self._units_per_m, self._most = depth_scale, most_depth_m(suffix, depth_scale)
        self._points = _POINTS if points is None else at_least("points", points, 1)
        self.is_metric = is_metric
        self.suffixes = {"depth": suffix, "color": ".png", "points": ".ply"}

    def write(self, files: Mapping[str, Path], predicted: PredictedImage) -> None:
        """Write depth, a colored picture and points."""
        if "depth" in files:
            write_depth_m(files["depth"], predicted.pixels, self._units_per_m)
        if "color" in files:
            picture = distance_picture(predicted.pixels, "m" if self.is_metric else "relative")
            write_pixels(files["color"], picture)
        if "points" in files:
            from trimesh import PointCloud  # half a second

            points, colors = points_of(predicted, spread_pixels(predicted, self._points))
            content: Any = PointCloud(points.astype(np.float32), colors).export(file_type="ply")
            write_bytes(files["points"], content)

    def read(self, file: Path) -> NDArray[Any]:
        """Read depth."""
        depth = read_depth_m(file, self._units_per_m)
        return np.where(depth > 0, depth, np.float32(np.nan))

    def painter(self, kind: str, entries: Sequence[Entry]) -> Painter:
        """Color depth by the range of all frames of the video."""
        ranges = [c for entry in entries if (c := entry["depth"].get("colors"))]
        near, far = zip(*ranges, strict=True) if ranges else ([1.0], [2.0])
        limits = min(near), max(far)
        return lambda rgb, depth: colorize_distance(depth, limits)

    def summarize(self, predicted: PredictedImage, is_counted: NDArray[np.bool_]) -> Any:
        """Return unit, shares of the solid angle, distances, range of the colors, alignment."""
        depth, angles = predicted.pixels, solid_angles(predicted)
        total = np.sum(angles, where=is_counted) or 1
        known, too_far = (
            np.sum(angles, where=mask) / total for mask in (np.isfinite(depth), depth > self._most)
        )
        facts = {"known": known, "too_far": too_far, **predicted.facts}
        summary: dict[str, Any] = {"unit": "m" if self.is_metric else "relative"}
        if known:
            median = np.median(depth[tuple(spread_pixels(predicted, _SAMPLES))])
            facts |= {"nearest": np.nanmin(depth), "median": median, "farthest": np.nanmax(depth)}
            summary["colors"] = [float(f"{limit:.4g}") for limit in distance_limits(depth)]
        return summary | {
            name: float(f"{value:.4g}") if isinstance(value, float | np.floating) else value
            for name, value in facts.items()
        }

    def table(self, entries: Sequence[Entry]) -> Table:
        """Return the means of the summaries over the images."""
        rows, unit = [], ", m" if self.is_metric else ""
        for name, title in _ROWS.items():
            values = [v for e in entries if (v := e["depth"].get(name)) is not None]
            if any(values) or (name == "known" and values):
                mean = np.mean(values) * (100 if "%" in title else 1)
                rows.append([title.format(unit=unit), f"{mean:.3g}"])
        steps = [(e["depth"].get("step_before"), e["depth"].get("step_after")) for e in entries]
        if worse := sum(None not in step and step[1] > _WORSE * step[0] for step in steps):
            rows.append(
                ["images whose views agree less than before: try another align", str(worse)]
            )
        kind = "depth in meters" if self.is_metric else "relative: median distance 1"
        return Table(f"Mean over the images ({kind})", ["quantity", "mean"], rows)
