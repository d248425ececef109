"""Distortion of ERP, cube map, tangent images: ``python -m studies.representation_distortion``.

A map of the sphere onto a plane has two principal scales at each point, a ≥ b (Tissot). The angle
between two directions changes by up to 2 asin((a − b)/(a + b)); areas are scaled by σ = a b. For
pinhole images a = 1/cos²θ and b = 1/cos θ at the angle θ from the center, for the ERP a = 1/cos φ
and b = 1 at the latitude φ.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.spatial import SphericalVoronoi, cKDTree

from studies.output import Row, save
from tangent_train.geometry import (
    CubeGrid,
    PinholeGrid,
    TangentGrid,
    equirect_directions,
    equirect_latitudes,
    equirect_solid_angles,
)
from tangent_train.results.chart import COLORS

Array = NDArray[np.float64]
GRIDS: dict[str, PinholeGrid | None] = {
    "ERP": None,
    "cube": CubeGrid(64),
    **{f"b = {b}": TangentGrid(b, b + 6) for b in range(5)},
}


def angle_to_owner(grid: PinholeGrid, directions: Array) -> Array:
    """Return ``(...)`` angles θ in radians from ``(..., 3)`` directions to the nearest center."""
    chord, _ = cKDTree(grid.centers_xyz).query(directions)
    return 2 * np.arcsin(np.minimum(chord / 2, 1))


def pinhole_distortion(theta: Array) -> tuple[Array, Array]:
    """Return angular distortion in radians and area scale of a pinhole image at the angle θ."""
    a, b = 1 / np.cos(theta) ** 2, 1 / np.cos(theta)
    return 2 * np.arcsin((a - b) / (a + b)), a * b


def distortion(grid: PinholeGrid | None, shape: tuple[int, int]) -> tuple[Array, Array]:
    """Return ``(H, W)`` angular distortion and area scale, at the pixels of a panorama.

    Args:
        grid: Geometry of the images, each within its owned region; None for the ERP itself.
        shape: ``(H, W)`` of the panorama.
    """
    if grid is not None:
        return pinhole_distortion(angle_to_owner(grid, equirect_directions(shape)))
    area = np.broadcast_to(1 / np.cos(equirect_latitudes(shape[0]))[:, None], shape)
    return 2 * np.arcsin((area - 1) / (area + 1)), area


def worst(grid: PinholeGrid | None) -> tuple[float, float]:
    """Return the greatest angular distortion in degrees and the greatest area scale."""
    if grid is None:
        return 180.0, np.inf
    corners = SphericalVoronoi(grid.centers_xyz).vertices
    angle, area = pinhole_distortion(angle_to_owner(grid, corners))
    return float(np.degrees(angle.max())), float(area.max())


def representation_distortion(shape: tuple[int, int] = (512, 1024)) -> list[Row]:
    """Return distortions of each representation: means over the sphere by solid angle, extremes.

    Args:
        shape: ``(H, W)`` of a panorama whose pixels are the samples.
    """
    weights = np.broadcast_to(equirect_solid_angles(shape)[:, None], shape)
    rows: list[Row] = []
    for name, grid in GRIDS.items():
        angle, area = distortion(grid, shape)
        worst_angle, greatest = worst(grid)
        mean = np.average(area, weights=weights)
        angle_mean = float(np.degrees(np.average(angle, weights=weights)))
        area_mean = float(100 * np.average(abs(area / mean - 1), weights=weights))
        row: Row = {"images": name, "angle mean °": angle_mean, "angle worst °": worst_angle}
        row |= {"area mean %": area_mean, "area least": float(1 / mean)}
        rows.append({**row, "area most": float(greatest / mean)})
    return rows


def picture(rows: Sequence[Row]) -> Figure:
    """Plot maps over the sphere, and bars of the means."""
    figure = Figure((11.5, 5.4), layout="constrained")
    upper, lower = np.array(figure.subfigures(2, 1))
    panels = upper.subplots(2, 5, subplot_kw={"xticks": [], "yticks": []})
    for axes, name in zip(panels.T, GRIDS, strict=False):
        angle, area = distortion(GRIDS[name], (128, 256))
        angles = axes[0].imshow(np.degrees(angle), vmin=0, vmax=40)
        areas = axes[1].imshow(area, norm=LogNorm(1, 3), cmap="magma")
        axes[0].set_title(name, loc="left")
    upper.colorbar(angles, ax=panels[0], extend="max", label="angle, degrees")
    scale = upper.colorbar(areas, ax=panels[1], extend="max", label="area, × the least")
    scale.set_ticks([1, 1.5, 2, 3], labels=["1", "1.5", "2", "3"], minor=False)
    for axes, column in zip(lower.subplots(1, 2), ("angle mean °", "area mean %"), strict=True):
        colors = [COLORS[6], COLORS[1], *[COLORS[0]] * 5]
        bars = axes.bar(list(GRIDS), [row[column] for row in rows], color=colors)
        axes.bar_label(bars, fmt="%.3g", fontsize=9)
        axes.set(title=f"{column} over the sphere", yscale="log", ymargin=0.1)
    return figure


if __name__ == "__main__":
    table = representation_distortion()
    save("representation_distortion", table, picture(table), digits=4)
