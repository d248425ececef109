"""Alignment of views: known corrections of true distances of a synthetic room are recovered."""

from __future__ import annotations

import math
from dataclasses import asdict
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy.optimize import minimize

from datamodules.synthrooms.raycast import RayScene
from datamodules.synthrooms.render import draw_camera
from datamodules.synthrooms.scene import draw_room_type, furnish
from tangent_train.errors import SettingError
from tangent_train.geometry import (
    CubeGrid,
    RingGrid,
    TangentGrid,
    camera_matrix_from_fov,
    equirect_directions,
    random_rotation,
)
from tangent_train.inference.alignment import (
    Alignment,
    ViewSamples,
    align,
    photo_points,
    sample_views,
    sphere_points,
)
from tangent_train.rendering import EquirectRepresentation, PerspectiveRepresentation
from tangent_train.rendering.representations.views import PinholeViews, Views

Kind = Any
SHAPE = (256, 512)
RINGS = [{"pitch": 0, "views": 6}, {"pitch": 45, "views": 5}, {"pitch": -45, "views": 5}]
KINDS = ["log_distance", "metric_distance", "metric_z", "relative_depth", "relative_disparity"]
EXACT = 1e-6


@cache
def _room(seed: int = 0) -> Any:
    """Return a function from directions ``(…, 3)`` to true distances, and its scene."""
    rng = np.random.default_rng(seed)
    room = furnish(rng, draw_room_type(rng))
    scene = RayScene(room)
    location = draw_camera(rng, scene, room.plan, []).location

    def distances(directions: NDArray[np.float64]) -> NDArray[np.float64]:
        rays = np.ascontiguousarray(directions.reshape(-1, 3), dtype=np.float32)
        return scene.cast(location, rays).distance.reshape(directions.shape[:-1]).astype(float)

    return distances


@cache
def _sets(name: str) -> list[PinholeViews]:
    rotation = random_rotation(np.random.default_rng(8))
    wide = RingGrid(RINGS, (110.0, 110.0), (24, 24), by_owners=False)
    return {
        "tangent": [PinholeViews(TangentGrid(0, 5))],
        "rotated": [PinholeViews(TangentGrid(0, 5).with_rotation(rotation))],
        "levels": [PinholeViews(TangentGrid(0, 5)), PinholeViews(CubeGrid(32))],
        "ring": [PinholeViews(wide)],
    }[name]


class Truth(NamedTuple):
    """Samples with the true distance, and the output of a network without errors."""

    samples: ViewSamples
    distance: NDArray[np.float64]


@cache
def _truth(name: str) -> Truth:
    points = sphere_points(SHAPE)[::4]
    empty = [np.zeros((len(views), *views.grid.size)) for views in _sets(name)]
    parts = [sample_views(a, v, SHAPE, points) for a, v in zip(empty, _sets(name), strict=True)]
    samples = ViewSamples.joined(parts)
    rows, columns = points[samples.point].T
    return Truth(samples, _room()(equirect_directions(SHAPE)[rows, columns]))


def _output(distance: Any, ray_length: Any, kind: Kind) -> Any:
    """Return what a network of a kind returns, from the definitions of the kinds."""
    z_depth = distance / ray_length
    return {
        "log_distance": np.log(distance),
        "metric_distance": distance,
        "metric_z": z_depth,
        "relative_depth": z_depth,
        "relative_disparity": 1 / z_depth,
    }[kind]


def _corrupted(truth: Truth, kind: Kind, rng: np.random.Generator) -> ViewSamples:
    """Return outputs of a network that multiplies each view by 0.2 to 5, and shifts it."""
    samples, count = truth.samples, truth.samples.num_views
    scale = np.exp(rng.normal(0, math.log(5) / 2, count)).clip(0.2, 5)[samples.view]
    output = _output(truth.distance, samples.ray_length, kind)
    if kind == "log_distance":
        return samples._replace(value=output + np.log(scale))
    shift = rng.uniform(-1, 1, count)[samples.view] * kind.startswith("relative")
    return samples._replace(value=output * scale + shift)


def _errors(found: Alignment, samples: ViewSamples, distance: NDArray[np.float64]) -> Any:
    """Return errors of logarithms of distances at the samples, up to one common scale."""
    value = np.exp(samples.value) if found.kind == "log_distance" else samples.value
    value = found.scale[samples.view] * value + found.shift[samples.view]
    if found.kind in ("metric_z", "relative_depth"):
        value = value * samples.ray_length
    if found.kind == "relative_disparity":
        value = samples.ray_length / value
    with np.errstate(invalid="ignore"):
        errors = np.log(value) - np.log(distance)
    return errors - np.nanmedian(errors)


CASES = [*((kind, "levels") for kind in KINDS), *((kind, "ring") for kind in KINDS[2:])]


@pytest.mark.parametrize(("kind", "views"), CASES)
def test_scales_and_shifts_of_views_are_recovered(kind: Kind, views: str) -> None:
    truth, rng = _truth(views), np.random.default_rng(5)
    samples = _corrupted(truth, kind, rng)
    found = align([samples], kind)
    assert np.abs(_errors(found, samples, truth.distance)).max() < EXACT
    assert found.report.mode == ("affine" if kind.startswith("relative") else "scale")
    assert np.median(np.log(found.scale)) == pytest.approx(0, abs=1e-12)
    assert found.report.step_before > 0.3
    assert found.report.step_after < EXACT
    assert found.report.groups == 1

    bad = rng.random(len(samples.value)) < 0.2
    wild = np.where(bad, samples.value * np.exp(rng.normal(0, 1, len(bad))), samples.value)
    wrong = samples._replace(value=wild)
    errors = _errors(align([wrong], kind), wrong, truth.distance)[~bad]
    assert np.abs(errors).max() < 1e-2
