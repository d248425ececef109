"""Curves as SVG inside HTML: axes, grid, legend, and the value of a point under the pointer."""

from __future__ import annotations

import html
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from tangent_train.errors import SettingError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tangent_train.results.html.parts import Curve

__all__ = ["curve_html", "ticks"]

_WIDTH, _HEIGHT = 420, 250
_LEFT, _RIGHT, _TOP, _BOTTOM = 70, 408, 12, 208
_MOST_POINTS = 200
_COLORS = 6


def ticks(least: float, most: float, about: int = 5) -> list[float]:
    """Round numbers that span a range: steps of 1, 2 or 5 times a power of ten.

    Args:
        least: Lower end.
        most: Upper end; the same as `least` is widened.
        about: How many steps are wanted.

    Returns:
        Ascending numbers, the first not above `least`, the last not below `most`.

    >>> ticks(0.03, 0.92)
    [0.0, 0.2, 0.4, 0.6, 0.8, 1.0]
    """
    if most <= least:
        room = abs(least) * 0.1 or 1.0
        least, most = least - room, most + room
    rough = (most - least) / about
    power = 10.0 ** math.floor(math.log10(rough))
    step = power * min((f for f in (1, 2, 5, 10) if f * power >= rough * 0.999), default=10)
    first, last = math.floor(least / step + 1e-9), math.ceil(most / step - 1e-9)
    return [float(f"{k * step:.12g}") for k in range(first, last + 1)]


def curve_html(curve: Curve) -> str:
    """A card with the curves, or nothing where no value is finite.

    Lines of more than 200 points are drawn through the means of as many groups of neighbours.

    Args:
        curve: The lines.

    Raises:
        SettingError: A line has another number of points than `x`.
    """
    lines = _lines(curve)
    heights = [y[np.isfinite(y)] for _, y in lines.values()]
    drawn = np.concatenate([*heights, np.empty(0)])
    if not drawn.size:
        return ""
    axes = _Axes.around(np.asarray(curve.x, np.float64), drawn)
    title = html.escape(curve.title)
    paths, names = [], []
    for k, (name, (x, y)) in enumerate(lines.items()):
        color = f"series-{k % _COLORS}"
        hints = [
            f"{name}: {value:.4g} at {curve.x_label} {at:.6g}"
            for at, value in zip(x, y, strict=True)
        ]
        paths += _line(axes.places(x, y), hints, color)
        names.append(f'<li class="{color}"><span>{html.escape(name)}</span></li>')
    return "\n".join(
        [
            f'<section class="card"><h2>{title}</h2>',
            f'<svg viewBox="0 0 {_WIDTH} {_HEIGHT}" role="img" aria-label="{title}">',
            *axes.drawn(),
            *_labels(curve),
            *paths,
            f'</svg><ul class="series">{"".join(names)}</ul></section>',
        ]
    )


class _Axes(NamedTuple):
    """Where values lie in the picture."""

    x_span: tuple[float, float]
    x_ticks: Sequence[float]
    y_ticks: Sequence[float]

    @classmethod
    def around(cls, x: NDArray[np.float64], y: NDArray[np.float64]) -> _Axes:
        """Axes that hold all points: x to its very ends, y to round numbers."""
        least, most = float(x.min()), float(x.max())
        x_ticks = ticks(least, most)
        if least == most:
            least, most = x_ticks[0], x_ticks[-1]
        inside = [value for value in x_ticks if least <= value <= most]
        return cls((least, most), inside, ticks(float(y.min()), float(y.max())))

    def places(self, x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
        """Points ``(n, 2)`` of the picture."""
        (left, right), low, high = self.x_span, self.y_ticks[0], self.y_ticks[-1]
        across = _LEFT + (x - left) / (right - left) * (_RIGHT - _LEFT)
        up = _BOTTOM - (y - low) / (high - low) * (_BOTTOM - _TOP)
        return np.stack([across, up], axis=1)

    def drawn(self) -> list[str]:
        """Axes, grid and numbers as SVG."""
        parts = []
        corner = np.full(len(self.y_ticks), self.x_span[0])
        for value, (_, y) in zip(
            self.y_ticks, self.places(corner, np.array(self.y_ticks)), strict=True
        ):
            text = f'<text x="{_LEFT - 6}" y="{y + 4:.1f}" text-anchor="end">{value:g}</text>'
            parts += [f'<path class="grid" d="M{_LEFT} {y:.1f}H{_RIGHT}"/>', text]
        corner = np.full(len(self.x_ticks), self.y_ticks[0])
        for value, (x, _) in zip(
            self.x_ticks, self.places(np.array(self.x_ticks), corner), strict=True
        ):
            text = f'<text x="{x:.1f}" y="{_BOTTOM + 17}" text-anchor="middle">{value:g}</text>'
            parts += [f'<path class="axis" d="M{x:.1f} {_BOTTOM}v4"/>', text]
        return [*parts, f'<path class="axis" fill="none" d="M{_LEFT} {_TOP}V{_BOTTOM}H{_RIGHT}"/>']


def _lines(curve: Curve) -> dict[str, tuple[NDArray[np.float64], NDArray[np.float64]]]:
    x = np.asarray(curve.x, np.float64)
    lines = {name: np.asarray(values, np.float64) for name, values in curve.series.items()}
    for name, y in lines.items():
        if y.shape != x.shape:
            raise SettingError(f"curve {name}", found=y.shape, expected=f"{x.shape}, as x")
    return {name: _thinned(x, y) for name, y in lines.items()}


def _thinned(
    x: NDArray[np.float64], y: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Means of groups of neighbours; a group without a finite value stays a gap."""
    if len(x) <= _MOST_POINTS:
        return x, y
    group = np.arange(len(x)) * _MOST_POINTS // len(x)
    finite = np.isfinite(y)
    number = np.bincount(group[finite], minlength=_MOST_POINTS)
    total = np.bincount(group[finite], weights=y[finite], minlength=_MOST_POINTS)
    means = np.divide(total, number, out=np.full(_MOST_POINTS, np.nan), where=number > 0)
    return np.bincount(group, weights=x) / np.bincount(group), means


def _labels(curve: Curve) -> list[str]:
    x, y = (_LEFT + _RIGHT) / 2, (_TOP + _BOTTOM) / 2
    return [
        f'<text x="{x:.1f}" y="{_HEIGHT - 6}" text-anchor="middle">{html.escape(curve.x_label)}'
        "</text>",
        f'<text transform="translate(13 {y:.1f}) rotate(-90)" text-anchor="middle">'
        f"{html.escape(curve.y_label)}</text>",
    ]


def _line(places: NDArray[np.float64], hints: Sequence[str], color: str) -> list[str]:
    """The line, and a circle with a hint for every point."""
    finite = [math.isfinite(y) for _, y in places.tolist()]
    neighbours = zip([False, *finite], [*finite[1:], False], strict=False)
    circles, steps = [], []
    for (x, y), hint, here, (before, after) in zip(
        places.tolist(), hints, finite, neighbours, strict=True
    ):
        if not here:
            continue
        steps.append(f"{'L' if before else 'M'}{x:.1f} {y:.1f}")
        kind = "point" if before or after else "point alone"
        circles.append(
            f'<circle class="{kind}" cx="{x:.1f}" cy="{y:.1f}" r="4">'
            f"<title>{html.escape(hint)}</title></circle>"
        )
    path = f'<path class="line {color}" d="{"".join(steps)}"/>'
    return [path, f'<g class="{color}">', *circles, "</g>"]
