"""Area of the subdivided icosahedron (the paper's figure): ``python -m studies.surface_area``."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from studies.output import Row, save
from tangent_train.geometry import icosphere
from tangent_train.results.chart import COLORS

SPHERES = ("of its mean radius", "vertices on it", "around the mesh")
"""Spheres for the comparison; the paper does not specify which it uses."""


def surface_area(levels: int = 8) -> list[Row]:
    """Return the area of the mesh after Loop subdivision, divided by the area of a sphere.

    Args:
        levels: Largest level.
    """
    rows: list[Row] = []
    for level in range(levels + 1):
        vertices, faces = icosphere(level)
        radius = np.linalg.norm(vertices, axis=1, keepdims=True)
        unit = 4 * math.pi
        area = mesh_area(vertices, faces) / unit
        on_sphere = mesh_area(vertices / radius, faces) / unit
        ratios = (area / radius.mean() ** 2, on_sphere, area / radius.max() ** 2)
        row: Row = {"level": level, "faces": len(faces), **dict(zip(SPHERES, ratios, strict=True))}
        rows.append({**row, "mean radius": float(radius.mean())})
    return rows


def mesh_area(vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> float:
    """Return the sum of the areas of triangles."""
    a, b, c = vertices[faces.T]
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)


def picture(rows: Sequence[Row]) -> Figure:
    """Plot the ratios, and their differences from 1."""
    figure = Figure((9, 4.2), layout="constrained")
    ratio, missing = figure.subplots(1, 2)
    levels = [row["level"] for row in rows]
    for sphere, color in zip(SPHERES, COLORS, strict=False):
        values = np.array([row[sphere] for row in rows])
        ratio.plot(levels, values, "o-", color=color, label=sphere)
        missing.semilogy(levels, 1 - values, "o-", color=color)
    ratio.axvline(3, color="0.2", linestyle="--")  # "note the leveling off"
    ratio.set(title="Area / area of the sphere", xlabel="level of subdivision")
    missing.set(title="1 − ratio", xlabel="level of subdivision")
    ratio.legend(title="sphere", frameon=False)
    return figure


if __name__ == "__main__":
    table = surface_area()
    save("surface_area", table, picture(table))
