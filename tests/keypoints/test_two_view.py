"""The motion between two panoramas: closed forms, sampled rays, COLMAP's answer."""

from __future__ import annotations

import math

import numpy as np
import pytest

from tangent_train.geometry import PanoramaPose, random_rotation
from tangent_train.keypoints.two_view import (
    Motion,
    TwoView,
    estimate_two_view,
    is_by_chance,
    motion_errors,
)
from tests.geometry.directions import angle_deg, unit
from tests.keypoints.scenes import Scene, rotation_angle_deg, two_views

pytest.importorskip("pycolmap")
HERE = PanoramaPose(np.eye(3), np.zeros(3))


def estimated(scene: Scene) -> TwoView:
    return estimate_two_view(scene.left_xyz, scene.right_xyz)


def differences(found: TwoView, scene: Scene) -> tuple[float, float]:
    assert found.rotation is not None
    rotation = rotation_angle_deg(found.rotation, scene.rotation)
    if found.translation is None:
        return rotation, float("nan")
    return rotation, float(angle_deg(found.translation, scene.translation_m))


# Errors of matches.


def test_errors_are_angles_to_projected_rays() -> None:
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


# Significance of a fit.


@pytest.mark.parametrize("inliers", [2, 3, 4, 5, 9])
def test_chance_of_a_rotation_is_that_of_caps(inliers: int) -> None:
    """Directions everywhere: a wrong match fits with the share of a cap, 0.0076 %."""
    rng = np.random.default_rng(0)
    left, right = unit(rng.normal(size=(2, 4000, 3)))
    right[:inliers] = left[:inliers]
    fits = int((angle_deg(left, right) <= 1).sum())
    share = math.sin(math.radians(0.5)) ** 2
    # The share is measured on shifted matches, which have about as much.
    alarms = (4000 - 2) * math.comb(4000, fits) * math.comb(fits, 2) * share ** (fits - 2)
    assert fits == inliers
    assert is_by_chance(left, right, Motion(np.eye(3)), math.radians(1)) == (
        fits <= 2 or alarms > 1
    )


# Estimates.


@pytest.mark.parametrize(("noise_deg", "wrong"), [(0, 0), (0.1, 300), (0.1, 480)])
def test_motion_is_found_among_noise_and_wrong_matches(noise_deg: float, wrong: int) -> None:
    scene = two_views(600, wrong=wrong, noise_deg=noise_deg, seed=2)
    found = estimated(scene)
    rotation, translation = differences(found, scene)
    assert found.kind == "general"
    assert rotation < 1e-4 + 1.5 * noise_deg
    assert translation < 1e-3 + 15 * noise_deg
    right = np.arange(600) >= wrong
    assert found.inliers[right].mean() > 0.99
    # By chance a wrong one lies in the band of a ray: 2° · 90° of 41 253 square degrees.
    assert found.inliers[~right].sum() <= 0.02 * wrong + 2


@pytest.mark.parametrize(("noise_deg", "seed"), [(0.0, 0), (0.3, 2)])
def test_two_panoramas_of_one_place_differ_by_a_rotation(noise_deg: float, seed: int) -> None:
    scene = two_views(400, baseline_m=0, wrong=200, noise_deg=noise_deg, seed=seed)
    found = estimated(scene)
    assert found.kind == "rotation"
    assert found.translation is None
    assert differences(found, scene)[0] < 0.02 + 0.2 * noise_deg
    apart = angle_deg(scene.left_xyz @ scene.rotation.T, scene.right_xyz)
    assert found.inliers[200:].mean() > (apart[200:] <= 1).mean() - 0.02
    assert found.inliers[:200].sum() <= 1  # a cap of 1° is 1/13000 of the sphere


@pytest.mark.parametrize(("count", "wrong"), [(0, 0), (1, 0), (7, 0), (30, 30), (1000, 1000)])
def test_too_few_or_wrong_matches_alone_have_no_motion(count: int, wrong: int) -> None:
    found = estimated(two_views(count, wrong=wrong, seed=2))
    assert found.kind == "none"
    assert found.inliers.shape == (count,)
    assert not found.inliers.any()
    assert found.rotation is found.translation is None
    assert np.isnan(found.pose_error_deg(HERE, HERE)).all()
