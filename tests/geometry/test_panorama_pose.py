"""Poses of panoramas, against plain trigonometry and homogeneous matrices."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from tangent_train.geometry import PanoramaPose, random_rotation, to_right_handed, xyz_to_lonlat


def posed(seed: int, mirrored: bool) -> PanoramaPose:
    rng = np.random.default_rng(seed)
    rotation = random_rotation(rng)
    return PanoramaPose(to_right_handed(rotation) if mirrored else rotation, rng.normal(size=3) * 4)


def test_a_panorama_in_a_right_handed_room() -> None:
    # It looks along the room's y axis, 1.5 m above the floor and lying on a side: right is up.
    pose = PanoramaPose([[0, 0, -1], [1, 0, 0], [0, 1, 0]], (3, 4, 1.5))
    ahead, right, up = np.eye(3)
    np.testing.assert_allclose(pose.points_m(ahead, 2), (3, 6, 1.5), atol=1e-15)
    np.testing.assert_allclose(pose.points_m(right, 2), (3, 4, 3.5), atol=1e-15)
    np.testing.assert_allclose(pose.points_m(up, 2), (1, 4, 1.5), atol=1e-15)
    direction, distance = pose.project((3, 4 - 1, 1.5 + np.sqrt(3)))
    np.testing.assert_allclose(np.degrees(xyz_to_lonlat(direction)), (120, 0), atol=1e-12)
    assert distance == pytest.approx(2)


@pytest.mark.parametrize("mirrored", [False, True])
def test_relative_poses_are_those_of_homogeneous_matrices(mirrored: bool) -> None:
    left, right = posed(4, mirrored), posed(5, mirrored)

    def homogeneous(pose: PanoramaPose) -> NDArray[np.float64]:
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = pose.world_from_panorama, pose.location_m
        return matrix

    expected = np.linalg.inv(homogeneous(right)) @ homogeneous(left)
    rotation, shift_m = right.relative_to(left)
    np.testing.assert_allclose(rotation, expected[:3, :3], atol=1e-12)
    np.testing.assert_allclose(shift_m, expected[:3, 3], atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1)
