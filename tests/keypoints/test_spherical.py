"""Keypoints on the sphere: sizes and orientations."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from tangent_train.geometry import rotation_about
from tangent_train.keypoints.features import angles_between, local_to_sphere
from tests.geometry.directions import random_directions
from tests.keypoints.scenes import keypoints_at


def skewed_maps(count: int = 40) -> NDArray[np.float64]:
    """Jacobians of maps to tangent planes: stretched, sheared, mirrored ones too."""
    points = keypoints_at(random_directions(count))
    across = np.cross(points.directions_xyz, points.orientations_xyz)
    basis = np.stack([points.orientations_xyz, across], axis=-1)
    linear = np.random.default_rng(1).normal(size=(count, 2, 2)) + 2 * np.eye(2)
    return np.asarray(0.01 * basis @ linear)


def test_orientations_are_those_of_the_gradient_on_the_sphere() -> None:
    jacobian = skewed_maps()
    rng = np.random.default_rng(2)
    # Gray values of slope g on the sphere have the slope Jᵀg in the image.
    on_sphere = np.einsum("nci,ni->nc", jacobian, rng.normal(size=(len(jacobian), 2)))
    in_image = np.einsum("nc,nci->ni", on_sphere, jacobian)
    angles = np.arctan2(in_image[:, 1], in_image[:, 0])
    _, orientations = local_to_sphere(jacobian, np.ones(len(jacobian)), angles)
    expected = on_sphere / np.linalg.norm(on_sphere, axis=1, keepdims=True)
    np.testing.assert_allclose(orientations, expected, atol=1e-9)


def test_sizes_are_diameters_of_discs_of_the_same_area() -> None:
    jacobian = skewed_maps()
    diameters = np.random.default_rng(3).uniform(1, 5, len(jacobian))
    sizes, _ = local_to_sphere(jacobian, diameters, np.zeros(len(jacobian)))
    angle = np.linspace(0, 2 * np.pi, 2001)
    circle = np.stack([np.cos(angle), np.sin(angle)]) / 2
    for matrix, diameter, size in zip(jacobian, diameters, sizes, strict=True):
        outline = matrix @ (diameter * circle)
        triangles = np.cross(outline[:, :-1].T, outline[:, 1:].T) / 2
        area = np.linalg.norm(triangles.sum(axis=0))
        assert np.pi * size**2 / 4 == pytest.approx(area, rel=1e-5)


def test_angles_are_precise_from_0_to_180_degrees() -> None:
    axis, start = np.array([0.6, 0, 0.8]), np.array([0.8, 0, -0.6])
    angles = np.array([0, 1e-12, 1e-5, 1.0, np.pi / 2, np.pi - 1e-5, np.pi])
    ends = np.array([rotation_about(axis, angle) @ start for angle in angles])
    np.testing.assert_allclose(angles_between(start, ends), angles, rtol=1e-9, atol=1e-15)
    assert angles_between(ends[:0], start).shape == (0,)
