"""Maps of the distortion over the sphere, and bars of its means."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.colors import LogNorm
from numpy.typing import NDArray

from studies.outcome import canvas, parts, plain, png, style
from tangent_train.geometry import CubeGrid, PinholeGrid, TangentGrid, equirect_latitudes
from tangent_train.geometry.distortion import (
    angular_distortion,
    equirect_scales,
    gnomonic_scales,
)
from tangent_train.rendering.tables import owner_table
from tangent_train.results.reports.chart import COLORS

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from studies.representation_distortion import Distortion

__all__ = ["distortion_maps", "distortion_png"]

_SHAPE = (128, 256)
_MOST_ANGLE_DEG = 40
_MOST_AREA = 3


def distortion_maps(
    grid: PinholeGrid | None, shape: tuple[int, int]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Distortion at every pixel of a panorama.

    Args:
        grid: The images, of which each counts where it is the owner; None for the panorama itself.
        shape: ``(H, W)``.

    Returns:
        ``(H, W)`` angular distortion in radians, and scale of areas over that in the middle of an
        image or on the equator.
    """
    if grid is None:
        lines = np.broadcast_to(equirect_latitudes(shape[0])[:, None], shape)
        scales = equirect_scales(lines)
    else:
        table = owner_table(grid, shape, np.dtype(np.float64))
        middle = (grid.dim - 1) / 2
        radius = np.hypot(table.u[0] - middle, table.v[0] - middle) * grid.pitch
        scales = gnomonic_scales(np.arctan(radius))
    return angular_distortion(*scales), scales[0] * scales[1]


def distortion_png(found: Mapping[str, Distortion]) -> bytes:
    """Maps of ERP, cube map and tangent images of b = 0, 1, 2; bars of the means of all.

    Args:
        found: The figures, by representation.

    Returns:
        A PNG file.
    """
    grids: dict[str, PinholeGrid | None] = {"ERP": None, "cube": CubeGrid(64)}
    grids |= {f"b = {b}": TangentGrid(b, b + 6) for b in range(3)}
    figure = canvas(11.5, 5.4)
    upper, lower = parts(figure, (1, 1))
    panels = upper.subplots(2, len(grids), squeeze=False)
    pictures = []
    for k, (name, grid) in enumerate(grids.items()):
        angle, area = distortion_maps(grid, _SHAPE)
        limits = {"vmin": 0, "vmax": _MOST_ANGLE_DEG, "cmap": "viridis"}
        pictures = [panels[0, k].imshow(np.degrees(angle), **limits)]
        shades = {"norm": LogNorm(1, _MOST_AREA), "cmap": "magma"}
        pictures.append(panels[1, k].imshow(area, **shades))
        panels[0, k].set_title(name, loc="left", fontsize=11)
    for axes in panels.flat:
        axes.set_xticks([])
        axes.set_yticks([])
    angles = upper.colorbar(pictures[0], ax=panels[0], extend="max", shrink=1.0)
    angles.set_label("angle, degrees")
    areas = upper.colorbar(pictures[1], ax=panels[1], extend="max", shrink=1.0)
    areas.set_label("area, × the least")
    areas.set_ticks([1, 1.5, 2, 3], labels=["1", "1.5", "2", "3"])
    areas.minorticks_off()
    left, right = lower.subplots(1, 2)
    _bars(left, {name: one.angle_mean_deg for name, one in found.items()}, "°")
    style(left, "Angle: mean over the sphere", "", "degrees")
    _bars(right, {name: 100 * one.area_mean for name, one in found.items()}, " %")
    style(right, "Area: mean deviation from the mean scale", "", "%")
    return png(figure)


def _bars(axes: Axes, heights: Mapping[str, float], unit: str) -> None:
    names, values = list(heights), list(heights.values())
    bars = axes.bar(names, values, color=[COLORS[6], COLORS[1], *[COLORS[0]] * len(names[2:])])
    axes.bar_label(bars, [f"{value:.3g}{unit}" for value in values], padding=2, fontsize=9)
    axes.set_yscale("log")
    axes.yaxis.set_major_formatter(plain)
    axes.set_ylim(min(values) / 2, max(values) * 3)
