"""Draw predictions: input, ground truth, prediction and error, with a legend."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tangent_train.io.palette import UNKNOWN_COLOR, class_colors, distance_colors
from tangent_train.metrics.segmentation import UNKNOWN

_Image = NDArray[np.uint8]
_MARGIN = 8
_LINE = 22
_LEAST_ROWS = 256
_LARGEST_ERROR = 0.5
_WRONG, _RIGHT = (214, 39, 40), (255, 255, 255)
_LEGEND_WIDTH = 1200
"""Width of a picture, in pixels, per step of its legend's size."""


def evenly_spread(count: int, total: int) -> NDArray[np.intp]:
    """Return at most `count` numbers from 0 to ``total - 1``, including the first and the last."""
    return np.linspace(0, total - 1, min(count, total)).round().astype(np.intp)


def distance_limits(*distances: NDArray[np.floating]) -> tuple[float, float]:
    """Return the ends of the color scale: percentiles 1 and 99 of the known distances.

    Args:
        distances: Maps that share one scale; NaN, infinite and 0 are unknown.
    """
    known = np.concatenate([d[np.isfinite(d) & (d > 0)] for d in distances])
    near, far = np.percentile(known, (1, 99)).tolist() if known.size else (1.0, 1.0)
    return near, max(far, 1.01 * near)


def colorize_distance(
    distance: NDArray[np.floating], limits: tuple[float, float] | None = None
) -> _Image:
    """Color distances ``(H, W)`` as RGB ``(H, W, 3)``: near bright, far dark, unknown gray.

    Colors change with the logarithm of the distance, as relative differences do.

    Args:
        distance: Distances in any unit; NaN, infinite and 0 are unknown.
        limits: Distances of the first and the last color; by default `distance_limits`.
    """
    near, far = limits or distance_limits(distance)
    is_known = np.isfinite(distance) & (distance > 0)
    place = np.log(np.where(is_known, distance, near) / near) / np.log(far / near)
    colors = distance_colors()[np.rint(255 * place.clip(0, 1)).astype(np.uint8)]
    return np.where(is_known[..., None], colors, UNKNOWN_COLOR)


def mixed_picture(
    rgb: _Image,
    labels: NDArray[np.integer],
    class_names: tuple[str, ...],
    segments: NDArray[np.integer] | None = None,
) -> _Image:
    """Overlay the lightness of a picture with its labels.

    The colors of the picture would change those of the classes and are left out. Class colors are
    not mixed along the borders between classes.

    Args:
        rgb: RGB picture ``(H, W, 3)``.
        labels: Labels ``(H, W)``; unknown pixels (0) show the picture, gray where it is black.
        class_names: Names of the K + 1 labels.
        segments: ``(H, W)`` numbers, between which borders are drawn; None for those of the labels.
    """
    light = cv2.cvtColor(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), cv2.COLOR_GRAY2RGB)
    colors = class_colors(class_names)[labels]
    mixed = cv2.addWeighted(light, 0.5, colors, 0.5, 0)
    is_border = _borders(labels if segments is None else segments)
    mixed[is_border] = colors[is_border]
    mixed[labels == UNKNOWN] = rgb[labels == UNKNOWN]
    mixed[(labels == UNKNOWN) & ~rgb.any(axis=-1)] = UNKNOWN_COLOR
    return mixed


def _borders(numbers: NDArray[np.integer]) -> NDArray[np.bool_]:
    """Return True for pixels ``(H, W)`` that differ from the one above or to the left."""
    across, down = (np.diff(numbers, axis=k, prepend=numbers.take([0], k)) != 0 for k in (0, 1))
    borders: NDArray[np.bool_] = across | down
    return borders


def with_class_legend(
    picture: _Image,
    labels: NDArray[np.integer],
    class_names: tuple[str, ...],
    others: Mapping[str, Any] = MappingProxyType({}),
) -> _Image:
    """Return a picture above a legend of the classes that occur, the largest first.

    The size of its text grows with the width.

    Args:
        picture: RGB ``(H, W, 3)``.
        labels: Labels of any shape.
        class_names: Names of the K + 1 labels.
        others: Further colors by name.
    """
    counts = np.bincount(labels.ravel(), minlength=len(class_names))
    seen = np.argsort(-counts, kind="stable")[: np.count_nonzero(counts)]
    entries = [(class_names[k], class_colors(class_names)[k]) for k in seen] + [*others.items()]
    width, scale = picture.shape[1], _scale(picture)
    longest = max((len(name) for name, _ in entries), default=0)
    cell, line, side = max(104, 30 + 9 * longest) * scale, _LINE * scale, 14 * scale
    per_row = max(1, width // cell)
    rows = -(-len(entries) // per_row)
    legend = np.full((rows * line + _MARGIN * scale, width, 3), 255, np.uint8)
    for k, (name, color) in enumerate(entries):
        x, y = k % per_row * cell + 2 * scale, k // per_row * line + _MARGIN * scale
        legend[y : y + side, x : x + side] = UNKNOWN_COLOR  # a frame around bright colors
        legend[y + scale : y + side - scale, x + scale : x + side - scale] = color
        _write(legend, name, (x + 19 * scale, y + 12 * scale), scale)
    return np.concatenate([picture, legend])


def _scale(picture: _Image) -> int:
    """Return the size of the text beside a picture."""
    return max(1, round(picture.shape[1] / _LEGEND_WIDTH))


def with_distance_legend(picture: _Image, limits: tuple[float, float], unit: str) -> _Image:
    """Return a picture above a bar of the colors with the first and the last distance.

    Args:
        picture: RGB ``(H, W, 3)``.
        limits: See `colorize_distance`.
        unit: Unit, e.g. m, or relative; it is printed after the last distance.
    """
    width, scale = picture.shape[1], _scale(picture)
    colors = distance_colors()[np.linspace(0, 255, width).astype(np.uint8)]
    bar = np.tile(colors, (_LINE * scale, 1, 1))
    near, far = f"{limits[0]:.3g}", f"{limits[1]:.3g} {unit}"
    _write(bar, near, (4 * scale, 16 * scale), scale)
    _write(bar, far, (width - (8 + 9 * len(far)) * scale, 16 * scale), scale, (255, 255, 255))
    return np.concatenate([picture, bar])


def prediction_panel(
    rgb: _Image,
    truth: NDArray[np.integer],
    prediction: NDArray[np.integer],
    class_names: tuple[str, ...],
    segments: Sequence[NDArray[np.integer]] = (),
) -> _Image:
    """Draw input, ground truth, prediction and error in a 2 × 2 grid above a legend.

    Args:
        rgb: Panorama ``(H, W, 3)``, or the crops of a photo side by side.
        truth: True labels ``(H, W)``; 0 is unknown.
        prediction: Predicted labels ``(H, W)``.
        class_names: Names of the K + 1 labels.
        segments: True and predicted numbers ``(H, W)``, between which borders are drawn.

    Returns:
        RGB image of about 2W × 2H; panoramas with less than 256 rows are enlarged by a whole
        factor. Errors are red, unlabeled pixels are gray.
    """
    colors = class_colors(class_names)
    error = np.where((prediction == truth)[..., None], _RIGHT, _WRONG)
    error[truth == UNKNOWN] = UNKNOWN_COLOR
    tiles = {"input": rgb, "ground truth": colors[truth], "prediction": colors[prediction]}
    for title, numbers in zip(("ground truth", "prediction"), segments, strict=False):
        tiles[title][_borders(numbers)] = 0
    grid, labels = _grid(tiles | {"error": error.astype(np.uint8)}), np.stack([truth, prediction])
    return with_class_legend(grid, labels, class_names, {"correct": _RIGHT, "wrong": _WRONG})


def distance_panel(
    rgb: _Image, truth: NDArray[np.floating], prediction: NDArray[np.floating]
) -> _Image:
    """Draw input, true and predicted distances with one color scale, and error in a 2 × 2 grid.

    Args:
        rgb: Panorama ``(H, W, 3)``, or the crops of a photo side by side.
        truth: True distances ``(H, W)`` in meters; NaN where unknown.
        prediction: Predicted distances ``(H, W)``.

    Returns:
        RGB image as of `prediction_panel`, above the color scale. Relative errors are white to red,
        from 0 to 50 %; pixels without a true distance are gray, those without a prediction are
        black.
    """
    limits = distance_limits(truth)
    share = np.abs(prediction - truth) / (_LARGEST_ERROR * truth)
    error = 255 + np.nan_to_num(share, posinf=1)[..., None].clip(0, 1) * (np.array(_WRONG) - 255)
    error[np.isnan(prediction)] = 0
    error[np.isnan(truth)] = UNKNOWN_COLOR
    tiles = {
        "input": rgb,
        "ground truth": colorize_distance(truth, limits),
        "prediction": colorize_distance(prediction, limits),
        "error: 0 white, 50 % red": error.round().astype(np.uint8),
    }
    return with_distance_legend(_grid(tiles), limits, "m")


def _grid(tiles: Mapping[str, _Image]) -> _Image:
    """Draw four images in a 2 × 2 grid, below their titles; small ones are enlarged."""
    titled = []
    for title, image in tiles.items():
        factor = max(1, _LEAST_ROWS // len(image))
        enlarged = image.repeat(factor, axis=0).repeat(factor, axis=1)
        scale = _scale(enlarged)
        strip = np.full((_LINE * scale, enlarged.shape[1], 3), 255, np.uint8)
        _write(strip, title, (2 * scale, 16 * scale), scale)
        titled.append(np.concatenate([strip, enlarged]))
    gap = np.full((len(titled[0]), _MARGIN, 3), 255, np.uint8)
    return np.concatenate([np.concatenate([titled[k], gap, titled[k + 1]], axis=1) for k in (0, 2)])


def _write(image: _Image, text: str, at: tuple[int, int], scale: int, color: Any = 0) -> None:
    font = cv2.FONT_HERSHEY_SIMPLEX
    cv2.putText(image, text, at, font, 0.45 * scale, color, scale, cv2.LINE_AA)


def shown_arrays(
    image: Any,
    target: Any,
    prediction: Any,
    representation: Any,
    most_rows: int | None = None,
    *,
    cut: bool = True,
    unknown: float = UNKNOWN,
) -> tuple[_Image, NDArray[Any], NDArray[Any]]:
    """Return a panorama with its labels, or the crops of a photo side by side.

    Args:
        image: `Panorama` or `Photo`.
        target: True labels or distances: ``(H, W)``, or ``(n, h, w)`` for crops.
        prediction: Predicted labels of the same shape.
        representation: Representation that defines the crops.
        most_rows: Largest number of rows, to which larger images are downsampled; None for all.
        cut: True to cut a partial panorama to the box around its valid pixels. Elsewhere, it is
            gray and unknown.
        unknown: Value of unknown pixels, see `Head`.

    Returns:
        RGB ``(H, W, 3)``, true and predicted labels ``(H, W)``; for crops, W is n·w. Where there is
        no picture, i.e. black without a label, RGB is gray, and both labels are unknown.
    """
    rgb, truth, labels = image.rgb, target.cpu().numpy(), prediction.cpu().numpy()
    if target.ndim == 3:
        (crops,) = image.sampler(representation).view_sets()
        rgb, truth, labels = map(np.hstack, (crops.render(rgb, "bilinear"), truth, labels))
    valid = image.valid if target.ndim == 2 else None
    is_seen = (rgb.any(axis=-1) | (truth > 0)) & (True if valid is None else valid)
    rgb = np.where(is_seen[..., None], rgb, UNKNOWN_COLOR)
    truth, labels = (np.where(is_seen, m, m.dtype.type(unknown)) for m in (truth, labels))
    if cut and valid is not None:
        box = _box(valid)
        rgb, truth, labels = (array[box] for array in (rgb, truth, labels))
    step = 1 if most_rows is None else -(-truth.shape[0] // most_rows)
    part = slice(step // 2, None, step)
    return rgb[part, part], truth[part, part], labels[part, part]


def _box(valid: NDArray[np.bool_]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return rows ``(h, 1)`` and columns ``(w,)`` of a box, which may continue across ±180°."""
    (rows,), (columns,) = (np.nonzero(valid.any(axis=axis)) for axis in (1, 0))
    gaps = np.diff(columns, append=columns[0] + valid.shape[1])
    first = columns[(gaps.argmax() + 1) % len(columns)]
    across = (first + np.arange(valid.shape[1] - gaps.max() + 1)) % valid.shape[1]
    return np.arange(rows[0], rows[-1] + 1)[:, None], across
