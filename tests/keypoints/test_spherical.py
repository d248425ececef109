from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from tangent_train.errors import SettingError
from tangent_train.geometry import (
    equirect_to_lonlat,
    lonlat_to_equirect,
    lonlat_to_xyz,
    random_rotation,
    rotation_about,
    xyz_to_lonlat,
)
from tangent_train.keypoints.spherical import (
    SphericalKeypoints,
    angles_between,
    equirect_jacobian,
    local_to_sphere,
    unit_directions,
)

SHAPE = (90, 210)
"""Neither even halves nor twice as wide as high."""


def keypoints(count: int = 50, seed: int = 0) -> SphericalKeypoints:
    rng = np.random.default_rng(seed)
    directions, others = rng.normal(size=(2, count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    tangents = np.cross(directions, others)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    return SphericalKeypoints(
        directions,
        rng.uniform(0.01, 0.1, count).astype(np.float32),
        tangents,
        rng.random(count, np.float32),
        rng.integers(0, 256, (count, 32), np.uint8),
        rng.integers(0, 20, count).astype(np.int32),
    )


def direction(pixels_xy: NDArray[np.float64]) -> NDArray[np.float64]:
    return lonlat_to_xyz(equirect_to_lonlat(pixels_xy, SHAPE))


def test_the_panoramas_jacobian_is_the_derivative() -> None:
    rng = np.random.default_rng(0)
    pixels = rng.uniform([-0.5, -0.4], [SHAPE[1] - 0.5, SHAPE[0] - 0.6], (200, 2))
    step = 1e-5
    numeric = np.stack(
        [
            (direction(pixels + step * axis) - direction(pixels - step * axis)) / (2 * step)
            for axis in np.eye(2)
        ],
        axis=-1,
    )
    np.testing.assert_allclose(
        equirect_jacobian(direction(pixels), SHAPE), numeric, rtol=0, atol=1e-9
    )


def skewed_maps(count: int = 40) -> NDArray[np.float64]:
    """Jacobians of maps to tangent planes: stretched, sheared, mirrored ones too."""
    points = keypoints(count)
    across = np.cross(points.directions_xyz, points.orientations_xyz)
    basis = np.stack([points.orientations_xyz, across], axis=-1)
    linear = np.random.default_rng(1).normal(size=(count, 2, 2)) + 2 * np.eye(2)
    return np.asarray(0.01 * basis @ linear)


def test_orientations_are_those_of_the_gradient_on_the_sphere() -> None:
    jacobian = skewed_maps()
    rng = np.random.default_rng(2)
    # Grey values of slope g on the sphere have the slope Jᵀg in the image.
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
    turn = np.linspace(0, 2 * np.pi, 2001)
    circle = np.stack([np.cos(turn), np.sin(turn)]) / 2
    for matrix, diameter, size in zip(jacobian, diameters, sizes, strict=True):
        outline = matrix @ (diameter * circle)
        triangles = np.cross(outline[:, :-1].T, outline[:, 1:].T) / 2
        area = np.linalg.norm(triangles.sum(axis=0))
        assert np.pi * size**2 / 4 == pytest.approx(area, rel=1e-5)


def test_there_and_back_from_a_panorama() -> None:
    rng = np.random.default_rng(4)
    pixels = rng.uniform([-0.5, -0.4], [SHAPE[1] - 0.5, SHAPE[0] - 0.6], (300, 2))
    diameters, angles = rng.uniform(1, 9, 300), rng.uniform(-np.pi, np.pi, 300)
    directions = direction(pixels)
    sizes, orientations = local_to_sphere(equirect_jacobian(directions, SHAPE), diameters, angles)
    base = keypoints(300)
    found = SphericalKeypoints(
        directions, sizes, orientations, base.responses, base.descriptors, base.images
    )
    np.testing.assert_allclose((orientations * directions).sum(axis=1), 0, atol=1e-12)
    np.testing.assert_allclose(found.equirect_pixels(SHAPE), pixels, atol=1e-9)
    np.testing.assert_allclose(found.equirect_sizes(SHAPE), diameters, rtol=1e-5)
    np.testing.assert_allclose(np.exp(1j * found.equirect_angles(SHAPE)), np.exp(1j * angles))


def test_sizes_and_angles_at_the_poles_are_finite() -> None:
    base = keypoints(2)
    poles = SphericalKeypoints(
        np.array([[0, 0, 1.0], [0, 0, -1]]),
        base.sizes_rad,
        np.array([[1, 0, 0.0], [0, 1, 0]]),
        base.responses,
        base.descriptors,
        base.images,
    )
    np.testing.assert_allclose(poles.equirect_pixels(SHAPE)[:, 1], [-0.5, SHAPE[0] - 0.5])
    np.testing.assert_array_equal(poles.equirect_sizes(SHAPE), SHAPE[0])
    assert np.isfinite(poles.equirect_angles(SHAPE)).all()


def test_angles_are_precise_from_0_to_180_degrees() -> None:
    axis, start = np.array([0.6, 0, 0.8]), np.array([0.8, 0, -0.6])
    angles = np.array([0, 1e-12, 1e-5, 1.0, np.pi / 2, np.pi - 1e-5, np.pi])
    ends = np.array([rotation_about(axis, angle) @ start for angle in angles])
    np.testing.assert_allclose(angles_between(start, ends), angles, rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose(angles_between(ends, start), angles, rtol=1e-9, atol=1e-15)
    assert angles_between(start, axis).shape == ()
    assert angles_between(ends[:0], start).shape == (0,)


def test_directions_of_any_length_become_unit_vectors() -> None:
    unit = unit_directions(np.array([[0, 3, -4], [1e-9, 0, 0]]))
    np.testing.assert_allclose(unit, np.array([[0, 0.6, -0.8], [1, 0, 0]]))
    assert unit_directions(np.empty((0, 3))).shape == (0, 3)
    for wrong, message in (
        ([1.0, 0, 0], r"shape \(3,\); expected \(n, 3\)"),
        ([[1.0, 0]], r"shape \(1, 2\)"),
        ([[0.0, 0, 0]], "0 or no numbers"),
        ([[np.inf, 0, 0]], "0 or no numbers"),
    ):
        with pytest.raises(SettingError, match=message):
            unit_directions(wrong)


def arrays(points: SphericalKeypoints) -> dict[str, NDArray[Any]]:
    return vars(points)


@pytest.mark.parametrize(
    "chosen", [np.arange(50) % 3 == 0, np.arange(50)[::-1], [4, 4, 0], [], np.zeros(50, bool)]
)
def test_select_takes_masks_and_indices(chosen: Any) -> None:
    points = keypoints()
    taken = points.select(chosen)
    index = np.flatnonzero(chosen) if np.asarray(chosen).dtype == np.bool_ else list(chosen)
    assert len(taken) == len(index)
    for name, values in arrays(taken).items():
        whole = arrays(points)[name]
        assert values.dtype == whole.dtype
        assert values.shape[1:] == whole.shape[1:]
        for value, k in zip(values, index, strict=True):
            np.testing.assert_array_equal(value, whole[k])


def test_concatenated_keeps_the_order() -> None:
    parts = [keypoints(3, 1), keypoints(0, 2), keypoints(4, 3)]
    whole = SphericalKeypoints.concatenated(parts)
    assert len(whole) == 7
    np.testing.assert_array_equal(whole.images, [*parts[0].images, *parts[2].images])
    np.testing.assert_array_equal(whole.select(range(3, 7)).descriptors, parts[2].descriptors)


def test_turned_moves_directions_and_orientations_together() -> None:
    points, turn = keypoints(), random_rotation(np.random.default_rng(5))
    turned = points.turned(turn)
    for k in (0, 17):
        np.testing.assert_allclose(turned.directions_xyz[k], turn @ points.directions_xyz[k])
        np.testing.assert_allclose(turned.orientations_xyz[k], turn @ points.orientations_xyz[k])
    assert turned.descriptors is points.descriptors
    with pytest.raises(SettingError, match="rotation"):
        points.turned(np.diag([1.0, -1, 1]))


def test_places_in_a_panorama_of_another_size() -> None:
    points = keypoints()
    lonlat = xyz_to_lonlat(points.directions_xyz)
    for shape in ((64, 128), (33, 47)):
        expected = lonlat_to_equirect(lonlat, shape)
        np.testing.assert_array_equal(points.equirect_pixels(shape), expected)


@pytest.mark.parametrize("name", list(arrays(keypoints(1))))
def test_arrays_that_do_not_belong_together_are_refused(name: str) -> None:
    parts = dict(arrays(keypoints(5)))
    parts[name] = parts[name][:4]
    with pytest.raises(SettingError, match="keypoints: found shapes"):
        SphericalKeypoints(**parts)
