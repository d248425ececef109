"""One scale for several panoramas of a room whose distances have closed forms."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from studies.depth_frames import errors
from tangent_train.geometry import (
    PanoramaPose,
    equirect_directions,
    random_rotation,
    to_right_handed,
)
from tangent_train.heads.scales import frame_scales, pose_scales
from tests.geometry.directions import unit
from tests.results.box_room import exit_points

Floats = NDArray[np.float64]
SHAPE = (128, 256)


def _walk(count: int, *, turned: bool, step_m: float = 0.2) -> tuple[list[PanoramaPose], Floats]:
    """Poses of a walk through the room, and distances."""
    rng = np.random.default_rng(0)
    poses = [
        PanoramaPose(
            to_right_handed(random_rotation(rng)) if turned else np.eye(3),
            (-1.5 + step_m * k, 2.5 * step_m * np.sin(k / 3), 0.1),
        )
        for k in range(count)
    ]
    return poses, np.stack([_distances(pose) for pose in poses])


def _distances(pose: PanoramaPose) -> Floats:
    rays = equirect_directions(SHAPE) @ pose.world_from_panorama.T
    return np.linalg.norm(exit_points(pose.location_m, rays) - pose.location_m, axis=-1)


def _scales(count: int) -> Floats:
    return np.exp(np.random.default_rng(1).normal(0.5, 0.4, count))


def _smooth_errors(count: int, spread: float) -> Floats:
    coarse = np.random.default_rng(2).normal(0, spread, (count, 8, 16))
    return np.exp([cv2.resize(one, SHAPE[::-1], interpolation=cv2.INTER_CUBIC) for one in coarse])


def _logs(found: Floats, true: Floats) -> Floats:
    return np.log(np.asarray(found) / true)


def test_frames_of_a_walk_get_one_scale() -> None:
    """Each frame is compared with the next, 0.2 m away; unknown pixels do not count."""
    _, distances = _walk(12, turned=False)
    true = _scales(12)
    seen = distances / true[:, None, None]
    seen[:, 118:] = np.nan
    seen[3, :, 40:90] = 0
    found, (before, after) = frame_scales(seen)
    logs = _logs(found, true)
    assert np.ptp(logs) < 0.02, "a drift below 2 % after 2.2 m"
    assert np.median(np.log(found)) == pytest.approx(0)
    assert before > 0.15
    assert after < 0.02


@pytest.mark.parametrize("common", [1, 0.1, 8])
def test_poses_give_their_unit(common: float) -> None:
    """Panoramas that are rotated at random, of networks that know no unit."""
    poses, distances = _walk(6, turned=True)
    true = _scales(6) * common
    found, (_, after) = pose_scales(distances / true[:, None, None], poses)
    assert np.abs(_logs(found, true)).max() < 0.01
    assert after < 0.02


def test_smooth_errors_of_a_network() -> None:
    """10 % of error per panorama: scales agree to 3 %, and their unit is found to 10 %."""
    poses, distances = _walk(12, turned=False)
    true = _scales(12)
    seen = distances / true[:, None, None] * _smooth_errors(12, 0.1)
    logs = _logs(pose_scales(seen, poses)[0], true)
    assert logs.std() < 0.03
    assert abs(logs.mean()) < 0.1


def test_surfaces_that_one_panorama_sees_are_outliers() -> None:
    """A cupboard beside the first camera; the order of the panoramas does not matter."""
    poses, distances = _walk(6, turned=False)
    near = distances[[0, 5]]
    near[0, :, :64] = 0.3
    true = np.array([0.7, 1.6])
    seen = near / true[:, None, None]
    found, _ = pose_scales(seen, [poses[0], poses[5]])
    assert np.abs(_logs(found, true)).max() < 0.02
    again, _ = pose_scales(seen[::-1], [poses[5], poses[0]])
    np.testing.assert_allclose(again[::-1], found, rtol=1e-4)


def test_points_that_panoramas_see_give_the_scale() -> None:
    """A third of the points lies elsewhere; the last panorama sees too few of them."""
    rng = np.random.default_rng(3)
    (pose, *_), distances = _walk(1, turned=True)
    true, poses = np.array([0.02, 3.0, 1.0]), [pose] * 3
    rays = unit(rng.normal(size=(3, 300, 3)))
    points = exit_points(pose.location_m, rays)
    points[:, :100] += rng.normal(0, 3, (3, 100, 3))
    seen = distances / true[:, None, None]
    seen[0, :, 60:120] = np.nan
    found, (_, after) = pose_scales(seen, poses, [points[0], points[1], points[2, 100:125]])
    np.testing.assert_allclose(found, [*true[:2], np.nan], rtol=0.01)
    assert after < 0.02


@pytest.mark.parametrize("step_m", [0.0, 0.01])
def test_without_parallax_nothing_determines_the_unit(step_m: float) -> None:
    poses, distances = _walk(3, turned=False, step_m=step_m)
    found, _ = pose_scales(distances * _smooth_errors(3, 0.1), poses)
    assert np.isnan(found).all()


@pytest.mark.parametrize(("step_m", "most"), [(0.1, 0.06), (0.2, 0.09)])
def test_frames_of_walks_through_synthetic_rooms(step_m: float, most: float) -> None:
    """Walks of 2 m past furniture, whose distances are ray-cast."""
    for seed in range(3):
        largest, of_neighbors = errors(np.random.default_rng(seed), step_m, 0)
        assert largest < most
        assert of_neighbors < 0.01
