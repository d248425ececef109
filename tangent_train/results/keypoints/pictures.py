"""Pictures of matches: the left panorama above the right one, inliers joined by lines."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

__all__ = ["DrawnMatches", "matches_picture"]

_GAP = 4
_TITLE_ROWS = 26
_PANEL_COLUMNS = 720
_MOST_LINES = 150
_SHIFT = 4  # bits of sub-pixel positions
_OTHER = (150, 40, 40)
_PAPER = 255


class DrawnMatches(NamedTuple):
    """Matches between two panoramas.

    Attributes:
        left_xy: ``(m, 2)`` pixel in the left panorama, centres at integers.
        right_xy: ``(m, 2)`` in the right one.
        inliers: ``(m,)`` bool.
    """

    left_xy: NDArray[np.float64]
    right_xy: NDArray[np.float64]
    inliers: NDArray[np.bool_]


def matches_picture(
    left: NDArray[np.uint8],
    right: NDArray[np.uint8],
    matches: Mapping[str, DrawnMatches],
    columns: int = _PANEL_COLUMNS,
) -> NDArray[np.uint8]:
    """Draw the matches of all representations of one pair.

    A panel each, in rows of up to three. Lines join inliers, at most 150, drawn at random from all
    of them; their hue is the longitude in the left panorama. Where the shorter way is across ±180°,
    a line leaves at one side and comes back at the other. Dark red dots are other matches.

    Args:
        left: ``(H, W, 3)`` uint8.
        right: ``(H', W', 3)`` uint8; drawn as wide as the left one.
        matches: By title of the panel.
        columns: Width of a panel in pixels.

    Returns:
        ``(h, w, 3)`` uint8 RGB.
    """
    panels = [_panel(title, left, right, found, columns) for title, found in matches.items()]
    across = math.ceil(len(panels) / math.ceil(len(panels) / 3))
    blank = np.full_like(panels[0], _PAPER)
    panels += [blank] * (-len(panels) % across)
    rows = [
        np.hstack([_framed(panel) for panel in panels[start : start + across]])
        for start in range(0, len(panels), across)
    ]
    return np.vstack(rows)


def _panel(
    title: str,
    left: NDArray[np.uint8],
    right: NDArray[np.uint8],
    found: DrawnMatches,
    columns: int,
) -> NDArray[np.uint8]:
    upper, lower = (_resized(image, columns) for image in (left, right))
    head = np.full((_TITLE_ROWS, columns, 3), _PAPER, np.uint8)
    text = f"{title}: {len(found.inliers)} matches, {int(found.inliers.sum())} inliers"
    cv2.putText(head, text, (4, 19), cv2.FONT_HERSHEY_SIMPLEX, 0.55, (0, 0, 0), 1, cv2.LINE_AA)
    between = np.full((_GAP, columns, 3), _PAPER, np.uint8)
    drawing = np.vstack([upper, between, lower])
    starts = _places(found.left_xy, left, columns)
    ends = _places(found.right_xy, right, columns)
    ends[:, 1] += len(upper) + _GAP
    for place in np.concatenate([starts[~found.inliers], ends[~found.inliers]]):
        _dot(drawing, place, _OTHER)
    inliers = np.flatnonzero(found.inliers)
    shown = np.random.default_rng(0).permutation(inliers)[:_MOST_LINES]
    for k in shown:
        _line(drawing, starts[k], ends[k], _hue(starts[k, 0] / columns))
    return np.vstack([head, drawing])


def _resized(image: NDArray[np.uint8], columns: int) -> NDArray[np.uint8]:
    """As wide as a panel, and paler, so that lines are seen."""
    rows = max(1, round(image.shape[0] * columns / image.shape[1]))
    smaller = cv2.INTER_AREA if columns < image.shape[1] else cv2.INTER_LINEAR
    resized = cv2.resize(image, (columns, rows), interpolation=smaller)
    return (resized // 2 + 96).astype(np.uint8)


def _places(
    pixels_xy: NDArray[np.float64], image: NDArray[np.uint8], columns: int
) -> NDArray[np.float64]:
    """Where pixels of a panorama are in its drawing, from centre to centre."""
    return (pixels_xy + 0.5) * (columns / image.shape[1]) - 0.5


def _line(
    drawing: NDArray[np.uint8],
    start: NDArray[np.float64],
    end: NDArray[np.float64],
    color: tuple[int, int, int],
) -> None:
    """Join two places by the shorter way around."""
    columns = drawing.shape[1]
    turn = columns * np.rint((start[0] - end[0]) / columns)
    for shift in {0.0, float(-turn)}:
        a = (start[0] + shift, start[1])
        b = (end[0] + turn + shift, end[1])
        cv2.line(drawing, _fixed(a), _fixed(b), color, 1, cv2.LINE_AA, _SHIFT)
    _dot(drawing, start, color)
    _dot(drawing, end, color)


def _dot(
    drawing: NDArray[np.uint8], place: NDArray[np.float64], color: tuple[int, int, int]
) -> None:
    cv2.circle(drawing, _fixed(place), 2 << _SHIFT, color, -1, cv2.LINE_AA, _SHIFT)


def _fixed(place: Sequence[float] | NDArray[np.float64]) -> tuple[int, int]:
    x, y = (round(float(v) * (1 << _SHIFT)) for v in place)
    return x, y


def _hue(share: float) -> tuple[int, int, int]:
    color = np.array([[[share % 1 * 360, 1.0, 0.85]]], np.float32)
    red, green, blue = (cv2.cvtColor(color, cv2.COLOR_HSV2RGB)[0, 0] * 255).round().astype(int)
    return int(red), int(green), int(blue)


def _framed(panel: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return np.pad(panel, ((0, _GAP), (0, _GAP), (0, 0)), constant_values=_PAPER)
