"""Alignment of views: known corrections of true distances of a synthetic room are recovered."""

from __future__ import annotations

import math
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy.optimize import minimize

from datamodules.synthrooms.furniture import build_room, draw_room_type
from datamodules.synthrooms.render import RayScene, draw_camera
from tangent_train.errors import SettingError
from tangent_train.geometry import (
    CubeGrid,
    RingGrid,
    TangentGrid,
    camera_matrix_from_fov,
    equirect_directions,
    perspective_directions,
    random_rotation,
)
from tangent_train.heads.alignment import (
    Alignment,
    ViewSamples,
    align_views,
    lattice,
    sample_views,
    sphere_points,
)
from tangent_train.rendering import EquirectRepresentation, PerspectiveRepresentation
from tangent_train.rendering.representations.views import PinholeViews, Views

Kind = Any
SHAPE = (256, 512)
RINGS = [{"pitch": 0, "views": 6}, {"pitch": 45, "views": 5}, {"pitch": -45, "views": 5}]
KINDS = ["metric_distance", "metric_z", "relative_depth", "relative_disparity"]
EXACT = 1e-6


@cache
def _room(seed: int = 0) -> Any:
    """Return a function from directions ``(…, 3)`` to true distances, and its scene."""
    rng = np.random.default_rng(seed)
    room = build_room(rng, draw_room_type(rng))
    scene = RayScene(room)
    location = draw_camera(scene).location

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
        "levels": [PinholeViews(TangentGrid(0, 5)), PinholeViews(TangentGrid(0, 4, 32))],
        "cube": [PinholeViews(TangentGrid(0, 5)), PinholeViews(CubeGrid(32))],
        "horizontal": [PinholeViews(wide)],
    }[name]


class Truth(NamedTuple):
    """Samples with the true distance, and the output of a network without errors."""

    samples: ViewSamples
    distance: NDArray[np.float64]


@cache
def _truth(name: str) -> Truth:
    points = sphere_points(SHAPE)[::4]
    empty = [torch.zeros((len(views), 1, *views.grid.size)) for views in _sets(name)]
    parts = [sample_views(a, v, SHAPE, points) for a, v in zip(empty, _sets(name), strict=True)]
    samples = ViewSamples.joined(parts)
    rows, columns = points[samples.point].T
    return Truth(samples, _room()(equirect_directions(SHAPE)[rows, columns]))


def _output(distance: Any, ray_length: Any, kind: Kind) -> Any:
    """Return what a network of a kind returns, from the definitions of the kinds."""
    z_depth = distance / ray_length
    return {"metric_distance": distance, "relative_disparity": 1 / z_depth}.get(kind, z_depth)


def _corrupted(truth: Truth, kind: Kind, rng: np.random.Generator) -> ViewSamples:
    """Return outputs of a network that multiplies each view by 0.2 to 5, and shifts it."""
    samples, count = truth.samples, truth.samples.num_views
    scale = np.exp(rng.normal(0, math.log(5) / 2, count)).clip(0.2, 5)[samples.view]
    shift = rng.uniform(-1, 1, count)[samples.view] * kind.startswith("relative")
    output = _output(truth.distance, samples.ray_length, kind)
    return samples._replace(value=output * scale + shift)


def _errors(found: Alignment, samples: ViewSamples, distance: NDArray[np.float64]) -> Any:
    """Return errors of logarithms of distances at the samples, up to one common scale."""
    value = found.scale[samples.view] * samples.value + found.shift[samples.view]
    if found.kind in ("metric_z", "relative_depth"):
        value = value * samples.ray_length
    if found.kind == "relative_disparity":
        value = samples.ray_length / value
    with np.errstate(invalid="ignore"):
        errors = np.log(value) - np.log(distance)
    return errors - np.nanmedian(errors)


CASES = [*((kind, "horizontal") for kind in KINDS), ("relative_disparity", "levels")]


def test_meters_remain_meters_with_a_shift_of_each_view() -> None:
    """Depth without any relation between views: the shifts of an affine fit cancel its scale."""
    samples = _truth("tangent").samples
    random = np.random.default_rng(0).uniform(1, 3, len(samples.value))
    found = align_views([samples._replace(value=random)], "metric_z", "affine")
    after = found.scale[samples.view] * random + found.shift[samples.view]
    known = after > 0  # else unknown
    factors = [np.median((after / random)[known & (samples.view == n)]) for n in range(20)]
    assert np.median(factors) == pytest.approx(1, rel=0.01)


@pytest.mark.parametrize(("kind", "views"), CASES)
def test_scales_and_shifts_of_views_are_recovered(kind: Kind, views: str) -> None:
    truth, rng = _truth(views), np.random.default_rng(5)
    samples = _corrupted(truth, kind, rng)
    found: Any = align_views([samples], kind)
    assert np.abs(_errors(found, samples, truth.distance)).max() < EXACT
    assert found.facts["mode"] == ("affine" if kind.startswith("relative") else "scale")
    if found.facts["mode"] == "scale":
        assert np.median(np.log(found.scale)) == pytest.approx(0, abs=1e-12)
    assert found.facts["step_before"] > 0.3
    assert found.facts["step_after"] < EXACT
    assert found.facts["groups"] == 1

    bad = rng.random(len(samples.value)) < 0.2
    wild = truth.distance * np.exp(bad * rng.normal(0, 1, len(bad)))
    wrong = _corrupted(truth._replace(distance=wild), kind, rng)
    errors = _errors(align_views([wrong], kind), wrong, truth.distance)[~bad]
    assert np.abs(errors).max() < 1e-2


@pytest.mark.parametrize(
    ("kind", "views", "seed"), [("metric_z", "levels", 3), ("relative_depth", "cube", 2)]
)
def test_views_with_a_wrong_start_are_no_outliers(kind: Kind, views: str, seed: int) -> None:
    """Most views agree soon: if the unit of noise followed at once, the others would stay."""
    truth = _truth(views)
    samples = _corrupted(truth, kind, np.random.default_rng(seed))
    errors = _errors(align_views([samples], kind), samples, truth.distance)
    assert np.abs(errors).max() < EXACT


def test_groups_of_views_keep_the_unit_of_their_median_view() -> None:
    """Three views of 50 points in millimeters, and three of other points in meters."""
    view, point = (part.ravel() for part in np.mgrid[:6, :50])
    factor = np.array([1000.0, 1000.0, 3000.0, 1.0, 2.0, 2.0])
    distance = np.random.default_rng(0).uniform(1, 4, 100)[point + 50 * (view > 2)]
    ones, positions = np.ones(len(view)), np.zeros((len(view), 2))
    given = point + 50 * (view > 2), distance * factor[view], ones, positions
    found = align_views([ViewSamples(6, view, *given)], "metric_distance")
    assert found.facts["groups"] == 2
    np.testing.assert_allclose(factor * found.scale, np.repeat([1000.0, 2.0], 3), rtol=1e-6)


def test_the_fit_minimizes_the_cauchy_loss() -> None:
    """Scales and shifts are those of a general optimizer, which evaluates the loss as defined."""
    rng = np.random.default_rng(1)
    view, point = (part.ravel() for part in np.mgrid[:4, :90])  # all views see all points
    distance, lengths = rng.uniform(1, 4, 90)[point], rng.uniform(1, 1.6, len(view))
    samples = ViewSamples(4, view, point, distance, lengths, np.zeros((len(view), 2)))
    noises = rng.normal(0, 0.03, len(view)) + 2 * (rng.random(len(view)) < 0.1)
    value = _corrupted(Truth(samples, distance), "relative_depth", rng).value * np.exp(noises)
    first, second = np.nonzero(np.triu(point[:, None] == point, 1))
    low, middle, high = np.quantile(value.reshape(4, 90), (0.25, 0.5, 0.75), axis=1)
    unit = np.maximum(high - low, np.abs(middle))

    def residuals(unknowns: NDArray[np.float64], levels: NDArray[np.float64]) -> Any:
        scale = np.exp(unknowns[:4])[view]
        depth, caused = scale * (value / unit[view] + unknowns[4:][view]) * lengths, scale * levels
        return (depth[first] - depth[second]) / np.hypot(caused[first], caused[second]) * 2**0.5

    def loss(unknowns: NDArray[np.float64], levels: NDArray[np.float64], noise: float) -> float:
        square = (residuals(unknowns, levels) / (2.385 * noise)) ** 2
        prior = ((unknowns[:4] - np.log(unit)) / 2) ** 2, unknowns[4:] ** 2
        return float(np.log1p(square).sum() * (2.385 * noise) ** 2 + noise**2 * np.sum(prior))

    unknowns, noise = np.concatenate([np.log(unit), np.zeros(4)]), 0.0
    for _ in range(40):
        levels = (value / unit[view] + unknowns[4:][view]) * lengths
        spread = 1.4826 * float(np.median(np.abs(residuals(unknowns, levels))))
        noise = max(spread, 0.7 * noise)
        unknowns = minimize(loss, unknowns, (levels, noise), "BFGS", options={"gtol": 1e-9}).x
    found = align_views([samples._replace(value=value)], "relative_depth")
    ratio = found.scale / (np.exp(unknowns[:4]) / unit)
    np.testing.assert_allclose(ratio, ratio[0], rtol=1e-4)
    np.testing.assert_allclose(found.shift, ratio * np.exp(unknowns[:4]) * unknowns[4:], atol=1e-4)


@pytest.mark.parametrize("noise", [0.4])
def test_noise_does_not_shrink_scales(noise: float) -> None:
    """Least squares without the unit of noise would shrink the noisier contrast by 1 / (1 + n²)."""
    rng = np.random.default_rng(2)
    view, point = (part.ravel() for part in np.mgrid[:3, :4000])
    lengths = rng.uniform(1, 1.6, len(view))
    z_depth = rng.normal(5, 1, 4000)[point] / lengths
    noisy = z_depth + rng.normal(0, noise, len(view))
    scale = np.array([0.5, 1.0, 3.0])
    samples = ViewSamples(3, view, point, noisy / scale[view], lengths, np.zeros((len(view), 2)))
    found = align_views([samples], "relative_depth")
    np.testing.assert_allclose(found.scale, scale, rtol=0.05)


@pytest.mark.parametrize("kind", ["metric_z", "relative_disparity"])
def test_views_that_cannot_be_compared_are_reported(kind: Kind) -> None:
    truth, rng = _truth("cube"), np.random.default_rng(4)
    samples = _corrupted(truth, kind, rng)
    value, view = samples.value.copy(), samples.view
    value[view == 2] = np.nan
    value[view == 5] = np.inf
    value[view == 7] = 3.0
    is_sky = rng.random(len(value)) < 0.05
    value[is_sky] = 0 if kind == "relative_disparity" else np.nan
    # Views 20 to 25, the cube, share no point with the others: a group of its own.
    point = np.where(view >= 20, samples.point + 10**6, samples.point)
    found = align_views([samples._replace(value=value, point=point)], kind)
    facts = found.facts
    assert (facts["empty"], facts["isolated"]) == (2, 6)
    assert facts["groups"] == 7  # the faces of a cube have no direction in common
    assert facts["constant"] == int(kind.startswith("relative"))
    assert (found.scale[[2, 5, *range(20, 26)]] == 1).all()
    assert (found.shift[[2, 5, 7, *range(20, 26)]] == 0).all()
    assert np.isfinite(found.scale).all()
    assert np.isfinite(found.shift).all()
    used = (view < 20) & ~np.isin(view, (2, 5, 7)) & ~is_sky
    errors = _errors(found, samples, truth.distance)[used]
    assert np.abs(errors - np.median(errors)).max() < 1e-4
    assert all(np.isfinite(v) for v in facts.values() if isinstance(v, float))


def _first_view(samples: ViewSamples) -> ViewSamples:
    arrays: Any = (array[samples.view == 0] for array in samples[1:])
    return ViewSamples(1, *arrays)


@pytest.mark.parametrize("mode", [None, "grid"])
def test_one_view_and_no_valid_view(mode: Any) -> None:
    samples = _truth("horizontal").samples
    nothing = samples._replace(value=np.full(len(samples.value), np.nan))
    found = align_views([nothing], "relative_disparity", mode)
    assert found.facts["empty"] == samples.num_views
    assert found.facts["step_after"] is None
    assert (found.scale == 1).all()
    one = _first_view(samples)
    alone = align_views([one._replace(value=one.ray_length)], "metric_z", mode)
    assert (alone.scale.item(), alone.shift.item(), alone.facts["groups"]) == (1, 0, 1)
    assert (alone.facts["isolated"], alone.facts["mode"]) == (0, "none")


def _views(name: str) -> tuple[Views, NDArray[np.float64], Any]:
    """Return views, the directions of the pixels of their canvas, and their optical axes."""
    rotation, directions = random_rotation(np.random.default_rng(2)), equirect_directions(SHAPE)
    if name == "erp":
        whole = EquirectRepresentation(6, rotations=3).with_rotation(rotation)
        return whole.view_sets()[1], directions, None
    if name == "photo":
        size = (120, 160)
        camera = camera_matrix_from_fov(80.0, size)
        (crops,) = PerspectiveRepresentation(6, 45.0, (48, 64)).of_camera(camera, size).view_sets()
        return crops, perspective_directions(camera, size), np.tile((0, 0, 1), (len(crops), 1))
    grid = TangentGrid(0, 6).with_rotation(rotation)
    return PinholeViews(grid), directions, grid.centers_xyz


@pytest.mark.parametrize("name", ["tangent", "erp", "photo"])
def test_views_are_sampled_where_the_canvas_is(name: str) -> None:
    views, directions, axes = _views(name)
    shape = directions.shape[0], directions.shape[1]
    points = lattice(shape) if name == "photo" else sphere_points(shape)
    image = 3 + directions @ (0.5, -0.3, 0.8)
    rendered = views.render(torch.from_numpy(image[None].astype(np.float32)), "bilinear")
    outputs = rendered[:, 0].numpy()
    outputs[:, 5, 7] = np.inf
    samples = sample_views(torch.from_numpy(outputs)[:, None], views, shape, points)
    assert samples.num_views == len(views)
    assert set(samples.point) == set(range(len(points)))  # the views cover the canvas
    rows, columns = points[samples.point].T
    known = np.isfinite(samples.value)
    assert 0 < (~known).sum() < 0.02 * len(known)
    errors = np.abs(samples.value - image[rows, columns])
    pixel = 1 / np.array(outputs.shape[:0:-1])
    inside = (np.abs(samples.position) < 1 - pixel).all(axis=1) if name != "erp" else known
    assert errors[known & inside].max() < 3e-3
    assert errors[known].max() < 3e-2  # the outer half of the outermost pixels is constant
    if name == "erp":
        assert np.isnan(samples.position).all()
        assert (samples.ray_length == 1).all()
        with pytest.raises(SettingError, match=r"grid.*none, scale or affine"):
            align_views([samples, samples], "metric_z", "grid")
        return
    assert np.abs(samples.position).max() <= 1
    cosines = (directions[rows, columns] * axes[samples.view]).sum(axis=-1)
    np.testing.assert_allclose(samples.ray_length, 1 / cosines, rtol=1e-2)


def test_a_grid_removes_smooth_errors_of_views() -> None:
    """Corrections of the logarithm, bilinear between 5 × 5 nodes, are applied where fitted."""
    grid, rng, points = TangentGrid(0, 5), np.random.default_rng(10), sphere_points(SHAPE)[::4]
    views = PinholeViews(grid)
    distance, lengths = _room()(grid.directions()), views.ray_lengths()
    y, x = np.mgrid[-1:1:32j, -1:1:32j]
    bent = rng.normal(0, 0.2, (20, 2, 1, 1)) * (x * y, y**2)
    output = distance / lengths * np.exp(bent.sum(axis=1))
    samples = sample_views(torch.from_numpy(output)[:, None], views, SHAPE, points)
    plain: Any = align_views([samples], "metric_z", "scale")
    corrected: Any = align_views([samples], "metric_z", "grid")
    assert plain.facts["step_after"] > 0.05
    assert corrected.facts["step_after"] < 0.2 * plain.facts["step_after"]
    assert corrected.grid.shape == (20, 5, 5)
    assert np.median(corrected.grid.mean(axis=(1, 2))) == pytest.approx(0, abs=1e-12)
    raw, rays = torch.from_numpy(output[:, None]), torch.from_numpy(lengths)
    applied = np.exp(corrected.applied(raw, slice(0, 20), rays)[:, 0].numpy())
    again = align_views(
        [sample_views(torch.from_numpy(applied)[:, None], views, SHAPE, points)],
        "metric_distance",
        "none",
    ).facts
    assert again["step_before"] == pytest.approx(corrected.facts["step_after"], rel=0.1)
    assert again["step_after"] == again["step_before"]

    exact = sample_views(torch.from_numpy(distance / lengths)[:, None], views, SHAPE, points)
    nothing: Any = align_views([exact], "metric_z", "grid")
    assert np.quantile(np.abs(nothing.grid), 0.9) < 0.02


def test_sky_and_invalid_pixels_after_the_alignment() -> None:
    raw = torch.tensor([2.0, 0.0, -1.0, math.nan, math.inf])[None, None, None]
    lengths = torch.full((1, 1, 5), 2.0)
    for kind, scale, shift, expected in (
        ("relative_disparity", 1.0, 0.0, [1, 0, 0]),
        ("relative_disparity", 2.0, 3.0, [3.5, 0, 0.5]),
        ("relative_depth", 2.0, 3.0, np.log([14, 6, 2])),
    ):
        depth_kind: Any = kind
        found = Alignment(depth_kind, np.array([scale]), np.array([shift]), None, {})
        values = found.applied(raw, slice(0, 1), lengths)[0, 0, 0].tolist()
        np.testing.assert_allclose(values[:3], expected, rtol=1e-6)
        assert all(map(math.isnan, values[3:]))
