"""Levels, sizes of panoramas, and how fine they are (paper, figure "icosahedral levels")."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

from studies.fov import BASE_LEVELS, has_images
from studies.outcome import Column, Outcome, canvas, plain, png, style
from tangent_train.geometry import TangentGrid, equirect_shape
from tangent_train.geometry.loop_lattice import LoopLattice
from tangent_train.results.reports.chart import COLORS

__all__ = ["CAMERAS", "PAPER_DEG", "Camera", "angular_resolution"]

PAPER_DEG = {0: 90.0, 1: 45.0, 5: 2.812, 7: 0.703, 8: 0.352, 10: 0.088}
"""Degrees per pixel as the paper prints them, by level."""


class Camera(NamedTuple):
    """A perspective camera to compare with.

    Attributes:
        name: What it is.
        height: Rows of its images.
        width: Columns.
        fov_deg: Angle across its columns.
        paper_deg: Degrees per pixel in the paper.
    """

    name: str
    height: int
    width: int
    fov_deg: float
    paper_deg: float | None = None


CAMERAS = (
    Camera("16² 45°", 16, 16, 45),
    Camera("128² 45°", 128, 128, 45),
    Camera("VGA 60°", 480, 640, 60, 0.094),
    Camera("1080p 60°", 1080, 1920, 60),
    Camera("4K 60°", 2160, 3840, 60),
)

_COLUMNS = (
    Column("what", "", ""),
    Column("name", "images", ""),
    Column("level", "level", ".3g"),
    Column("rows", "rows", "d"),
    Column("columns", "cols", "d"),
    Column("deg_per_pixel", "° per\npixel", ".4f"),
    Column("paper_deg_per_pixel", "paper", ".5g"),
    Column("vertices", "vertices", ",d"),
    Column("faces", "faces", ",d"),
    Column("vertex_resolution_deg"),
    Column("fov_deg"),
    *(Column(f"tangent_b{b}_deg_per_pixel") for b in BASE_LEVELS),
)
_NOTES = (
    "Degrees per pixel: of a panorama 360°/columns on its equator, of a camera the angle of view "
    "over the columns, as in the paper; a camera's level is that of the panorama as fine as that, "
    "log₂(90/degrees). The paper trains on photos of 128² at 45° for level 8, and likens level 5 "
    "to 16².",
    "The paper prints 20,971,510 faces for level 10; 20·4¹⁰ are 20,971,520. Its VGA camera spans "
    "45° × 60°: with square pixels 60° across 640 columns are 46.8° across 480 rows.",
)


def angular_resolution(levels: int) -> Outcome:
    """Panoramas of each level beside perspective cameras.

    Args:
        levels: The last level; all from 0 on are listed.
    """
    lattice = LoopLattice.of_icosahedron()
    rows = [_of_level(lattice)]
    for _ in range(levels):
        lattice = lattice.subdivided()
        rows.append(_of_level(lattice))
    cameras = [_of_camera(camera) for camera in CAMERAS]
    title = "Angular resolution of panoramas and cameras"
    return Outcome(title, _COLUMNS, [*rows, *cameras], _NOTES, _picture(rows))


def _of_level(lattice: LoopLattice) -> list[Any]:
    level = lattice.level
    height, width = equirect_shape(level)
    between = math.degrees(lattice.vertex_resolution())
    size = (level, height, width, 360 / width, PAPER_DEG.get(level))
    tangent = [_tangent_deg(b, level) for b in BASE_LEVELS]
    mesh = (lattice.num_vertices, lattice.num_faces, between)
    return ["panorama", "panorama", *size, *mesh, 360.0, *tangent]


def _tangent_deg(base_level: int, level: int) -> float | None:
    """Degrees per pixel in the middle of a tangent image, if there are such images."""
    if not has_images(base_level, level):
        return None
    return math.degrees(TangentGrid(base_level, level).pitch)


def _of_camera(camera: Camera) -> list[Any]:
    degrees = camera.fov_deg / camera.width
    size = (math.log2(90 / degrees), camera.height, camera.width, degrees, camera.paper_deg)
    nothing = [None] * (3 + 1 + len(BASE_LEVELS))
    return ["camera", camera.name, *size, *nothing[:3], camera.fov_deg, *nothing[4:]]


def _picture(rows: Sequence[Sequence[Any]]) -> bytes:
    figure = canvas(8.5, 5.0)
    axes = figure.subplots()
    levels = [row[2] for row in rows]
    axes.semilogy(levels, [row[5] for row in rows], "o-", color=COLORS[0], label="panorama (ERP)")
    between = [row[9] for row in rows]
    axes.semilogy(levels, between, "s:", color=COLORS[6], label="between vertices (R_v)")
    tangent = [(row[2], row[12]) for row in rows if row[12] is not None]
    if tangent:
        label = "middle of a tangent image, b = 1"
        axes.semilogy(*zip(*tangent, strict=True), "^--", color=COLORS[2], label=label)
    known = [level for level in levels if level in PAPER_DEG]
    printed = [PAPER_DEG[level] for level in known]
    axes.semilogy(known, printed, "D", ms=8, color="none", mec="black", label="the paper")
    for camera in CAMERAS:
        degrees = camera.fov_deg / camera.width
        axes.axhline(degrees, color=COLORS[5], linewidth=1)
        axes.annotate(
            f"{camera.name}: {degrees:.3f}°",
            (0, degrees),
            (-4, 3),
            textcoords="offset points",
            fontsize=8,
        )
    axes.set_xticks(levels)
    axes.yaxis.set_major_formatter(plain)
    style(axes, "Angular resolution", "level", "degrees per pixel")
    axes.legend(frameon=False)
    return png(figure)
