"""Distortion of panoramas, cube maps and tangent images, in closed form and measured."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from studies.distortion_picture import distortion_png
from studies.fov import BASE_LEVELS
from studies.measured import Measured, measure_equirect, measure_grid
from studies.outcome import Column, Outcome
from tangent_train.geometry import CubeGrid, PinholeGrid, TangentGrid
from tangent_train.geometry.distortion import (
    angular_distortion,
    equirect_mean_angular_distortion,
    equirect_mean_area_deviation,
    gnomonic_scales,
)
from tangent_train.geometry.owned_cells import mean_over_owned, owned_polygons

__all__ = ["Distortion", "closed_form", "closed_form_equirect", "representation_distortion"]

_MEASURED = 64
"""Images of a base level, or as many as come from one face of the icosahedron, if those are more:
every face looks like the others."""

_COLUMNS = (
    Column("representation", "images", ""),
    Column("images"),
    Column("angle_mean_deg", "angle mean °", ".4g"),
    Column("angle_mean_measured_deg", "pixels", ".4g"),
    Column("angle_worst_deg", "angle worst °", ".4g"),
    Column("angle_worst_measured_deg"),
    Column("area_mean_percent", "area mean %", ".4g"),
    Column("area_mean_measured_percent", "pixels", ".4g"),
    Column("area_least", "area least", ".4f"),
    Column("area_least_measured"),
    Column("area_greatest", "area most", ".4f"),
    Column("area_greatest_measured"),
)


@dataclass(frozen=True)
class Distortion:
    """Distortion of a representation over the sphere, by solid angle.

    Attributes:
        angle_mean_deg: Mean angular distortion.
        angle_worst_deg: The greatest.
        area_mean: Mean of |σ/σ̄ − 1|, σ the scale of areas and σ̄ its mean.
        area_least: The least σ/σ̄.
        area_greatest: The greatest.
    """

    angle_mean_deg: float
    angle_worst_deg: float
    area_mean: float
    area_least: float
    area_greatest: float

    @classmethod
    def of(cls, measured: Measured) -> Distortion:
        """What was measured at pixels."""
        return cls(
            math.degrees(measured.mean_angle_rad),
            math.degrees(measured.worst_angle_rad),
            measured.mean_area_deviation,
            *measured.area_range,
        )


def closed_form_equirect() -> Distortion:
    """The panorama; at the poles angles are off by 180° and areas without bound."""
    mean = math.degrees(equirect_mean_angular_distortion())
    return Distortion(mean, 180.0, equirect_mean_area_deviation(), 2 / math.pi, math.inf)


def closed_form(grid: PinholeGrid, faces: range | None = None) -> Distortion:
    """Pinhole images, each where it is the owner.

    Args:
        grid: The images.
        faces: Those that by symmetry stand for all others, default all.
    """
    mean_area = mean_over_owned(grid, _area, faces)

    def deviation(angle_rad: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.abs(_area(angle_rad) / mean_area - 1)

    corner = np.arctan(np.linalg.norm(owned_polygons(grid, faces), axis=-1).max())
    return Distortion(
        math.degrees(mean_over_owned(grid, _angle, faces)),
        math.degrees(float(_angle(corner))),
        mean_over_owned(grid, deviation, faces),
        1 / mean_area,
        float(_area(corner)) / mean_area,
    )


def representation_distortion(side: int) -> Outcome:
    """Mean and worst distortion of angles and areas.

    Args:
        side: Of the images whose maps are measured, in pixels; a power of 2, 16 or more.
    """
    shape = (2 * side, 4 * side)
    equirect = (closed_form_equirect(), Distortion.of(measure_equirect(shape)))
    found = {"ERP": (1, *equirect), "cube": (6, *_both(CubeGrid(side), range(6)))}
    for b in BASE_LEVELS:
        grid = TangentGrid(b, b + side.bit_length() - 1)
        images = 4**b * max(1, _MEASURED // 4**b)
        both = _both(grid, range(min(images, grid.num_images)))
        found[f"b = {b}"] = (grid.num_images, *both)
    rows = [[name, images, *_figures(*pair)] for name, (images, *pair) in found.items()]
    notes = (
        "Means are over the sphere, by solid angle; what several tangent images see counts where "
        "it is owned. Angle: how much the angle between two directions can be off. Area: scale of "
        "areas over its mean, so that a zoom is no distortion; its mean is that of the deviation "
        "from 1. b: tangent images of that base level.",
        f"Pixels: the same, measured between the pixels of a panorama of {shape[0]} × {shape[1]}, "
        f"of cube faces and tangent images of {side}², where the renderers sample them; worst, "
        "least and most are in the CSV file. Towards the panorama's poles they grow without end.",
    )
    title = "Distortion over the sphere"
    picture = distortion_png({name: pair[0] for name, (_, *pair) in found.items()})
    return Outcome(title, _COLUMNS, rows, notes, picture)


def _both(grid: PinholeGrid, images: range) -> tuple[Distortion, Distortion]:
    return closed_form(grid, images), Distortion.of(measure_grid(grid, images))


def _figures(closed: Distortion, measured: Distortion) -> list[Any]:
    """The columns after the first two."""
    readings: tuple[Callable[[Distortion], float], ...] = (
        lambda found: found.angle_mean_deg,
        lambda found: found.angle_worst_deg,
        lambda found: 100 * found.area_mean,
        lambda found: found.area_least,
        lambda found: found.area_greatest,
    )
    return [reading(found) for reading in readings for found in (closed, measured)]


def _area(angle_rad: NDArray[np.float64]) -> NDArray[np.float64]:
    greatest, least = gnomonic_scales(angle_rad)
    return greatest * least


def _angle(angle_rad: NDArray[np.float64]) -> NDArray[np.float64]:
    return angular_distortion(*gnomonic_scales(angle_rad))
