"""Where a match may lie: against finely sampled rays and closed forms."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from tangent_train.geometry import random_rotation, rotation_about
from tangent_train.keypoints.epipolar import (
    Motion,
    chance_share,
    log_false_alarms,
    motion_errors,
    prefers_rotation,
)
from tests.keypoints.scenes import angle_deg, two_views, unit

RNG = np.random.default_rng(0)


def test_errors_are_the_distances_to_the_rays_as_they_appear() -> None:
    rng = np.random.default_rng(1)
    rotation, t = random_rotation(rng), unit(rng.normal(size=3))
    left, right = unit(rng.normal(size=(2, 60, 3)))
    # Points along the rays, from the camera to nearly infinitely far away, evenly in angle.
    depths = np.tan(np.linspace(0, np.pi / 2 - 1e-7, 20_001))[:, None]
    expected = []
    for one, other in zip(left, right, strict=True):
        in_right = unit(depths * (rotation @ one) + t)
        in_left = unit((depths * other - t) @ rotation)
        expected.append(max(angle_deg(in_right, other).min(), angle_deg(in_left, one).min()))
    errors = np.degrees(motion_errors(left, right, Motion(rotation, t)))
    np.testing.assert_allclose(errors, expected, atol=0.03)
    assert errors.max() > 90  # beyond the ends of arcs, too


def test_true_matches_have_no_error() -> None:
    scene = two_views(200, seed=2)
    motion = Motion(scene.rotation, unit(scene.translation_m))
    assert motion_errors(scene.left_xyz, scene.right_xyz, motion).max() < 1e-14
    # What the essential matrix allows but lies behind a camera is an error.
    behind = motion_errors(scene.left_xyz, -scene.right_xyz, motion)
    assert np.degrees(behind).min() > 10


def test_errors_perpendicular_to_the_arc_are_angles() -> None:
    # The left one looks ahead, the right one stands 1 m to its right: points ahead at distance d
    # are seen at longitude −atan(1 / d), and 2° above that the error is 2°.
    motion = Motion(np.eye(3), np.array([0, -1.0, 0]))
    left = np.tile([1.0, 0, 0], (3, 1))
    seen = unit([(d, -1, 0) for d in (1, 3, 40)])
    raised = np.cos(np.radians(2)) * seen + np.sin(np.radians(2)) * np.array([0, 0, 1])
    np.testing.assert_allclose(
        np.degrees(motion_errors(left, raised, motion)),
        # From the right one's side the arc of a point close by is steeper: the left one is nearer.
        [max(2.0, float(angle_deg(left[0], plane_nearest(one)))) for one in raised],
        atol=1e-9,
    )


def plane_nearest(right: NDArray[np.float64]) -> NDArray[np.float64]:
    """The direction in the plane of `right` and the baseline that is nearest to (1, 0, 0)."""
    normal = unit(np.cross(right, [0, 1, 0]))
    ahead = np.array([1.0, 0, 0])
    return unit(ahead - normal * (ahead @ normal))


def test_a_rotation_allows_one_direction() -> None:
    rng = np.random.default_rng(3)
    rotation = random_rotation(rng)
    left = unit(rng.normal(size=(50, 3)))
    offsets = np.radians(rng.uniform(0, 180, 50))
    axes = unit(np.cross(left, rng.normal(size=(50, 3))))
    moved = [rotation_about(a, o) @ d for a, o, d in zip(axes, offsets, left, strict=True)]
    right = np.array(moved) @ rotation.T
    np.testing.assert_allclose(
        motion_errors(left, right, Motion(rotation, None)), offsets, atol=1e-9
    )


@pytest.mark.parametrize("sign", [1, -1])
def test_along_the_baseline_errors_are_finite(sign: int) -> None:
    t = np.array([0, 0, 1.0])
    left = np.array([[0, 0, sign * 1.0]])
    motion = Motion(np.eye(3), t)
    # Upwards is the left camera, seen from the right one; downwards the arc ends nowhere else.
    errors = motion_errors(np.repeat(left, 2, 0), np.array([[0, 0, 1.0], [0, 0, -1.0]]), motion)
    assert np.isfinite(errors).all()
    assert errors[0 if sign == 1 else 1] == pytest.approx(0, abs=1e-12)


def test_the_chance_of_a_rotation_is_the_share_of_a_cap() -> None:
    left, right = unit(RNG.normal(size=(2, 4000, 3)))
    share = chance_share(left, right, Motion(np.eye(3), None), np.radians(20))
    assert share == pytest.approx((1 - math.cos(np.radians(20))) / 2, rel=0.05)


def test_the_chance_of_a_motion_is_the_share_of_a_band() -> None:
    left, right = unit(RNG.normal(size=(2, 4000, 3)))
    narrow = np.radians(3)
    motion = Motion(random_rotation(RNG), unit(RNG.normal(size=3)))
    # Arcs are 90° long on average: a band of 2 · 3° · 90° less what the other side denies.
    band = (2 * narrow * np.pi / 2 + np.pi * narrow**2) / (4 * np.pi)
    assert 0.5 * band < chance_share(left, right, motion, narrow) < band


def test_chance_knows_where_keypoints_are() -> None:
    # All directions within 10° of one: half of all wrong matches are within 10° of each other.
    rays = unit(np.array([1.0, 0, 0]) + 0.1 * RNG.uniform(-1, 1, (2000, 3)))
    assert chance_share(rays, rays[::-1], Motion(np.eye(3), None), np.radians(10)) > 0.4


def test_chance_of_few_matches_is_at_least_that_of_a_point() -> None:
    ray = np.array([[1.0, 0, 0]])
    point = math.sin(np.radians(0.5)) ** 2
    for count in (1, 2, 3):
        left = np.repeat(ray, count, axis=0)
        share = chance_share(left, -left, Motion(np.eye(3), None), np.radians(1))
        assert share == pytest.approx(point)


@pytest.mark.parametrize(
    ("matches", "inliers", "sample", "share"),
    [(6, 6, 5, 0.004), (40, 12, 5, 0.01), (50, 50, 2, 1e-4), (300, 20, 5, 0.3)],
)
def test_false_alarms_are_those_of_the_formula(
    matches: int, inliers: int, sample: int, share: float
) -> None:
    expected = (
        (matches - sample)
        * math.comb(matches, inliers)
        * math.comb(inliers, sample)
        * share ** (inliers - sample)
    )
    found = log_false_alarms(matches, inliers, sample, share)
    assert found == pytest.approx(math.log(expected), abs=1e-9)


def test_a_sample_alone_says_nothing() -> None:
    assert log_false_alarms(100, 5, 5, 0.001) == math.inf


def test_gric_of_a_hand_computed_example() -> None:
    # Errors in units of σ = 1.4826 · median = 1; three matches, one of them allowed by neither.
    sigma = 0.01
    general = np.array([sigma / 1.4826, sigma / 1.4826, 9])
    n = 2
    cost_general = n / 1.4826**2 + n * 3 * math.log(4) + 5 * math.log(4 * n)
    for error, expected in ((0.0, 0.0), (1.5, 2 * 1.5**2), (9.0, 2 * 4.0)):
        rotation = np.array([error * sigma, error * sigma, 9])
        cost_rotation = expected + n * 2 * math.log(4) + 3 * math.log(4 * n)
        wanted = cost_rotation < cost_general
        assert prefers_rotation(general, rotation, 0.02, 1e-6) is wanted
    assert not prefers_rotation(np.tile(general, 40), np.full(120, 4 * sigma), 0.02, 1e-6)
