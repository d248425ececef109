from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from tangent_train.errors import SettingError
from tangent_train.geometry import (
    TangentGrid,
    icosphere,
    lonlat_to_xyz,
    random_rotation,
)
from tangent_train.keypoints.detectors import Detector
from tangent_train.keypoints.spherical import SphericalKeypoints
from tangent_train.keypoints.tangent import (
    _repeated,
    detect_on_tangent_images,
    gnomonic_jacobian,
)
from tests.keypoints.textures import Agreement, angles_deg, blobs, disc, texture

LEVEL = 7
SHAPE = (256, 512)
TURN = random_rotation(np.random.default_rng(1))


@lru_cache
def found_on_texture(
    base_level: int, margin: int, *, turned: bool, name: str = "sift"
) -> SphericalKeypoints:
    image = texture(SHAPE, TURN if turned else None)
    return detect_on_tangent_images(image, TangentGrid(base_level, LEVEL), Detector(name), margin)


@pytest.mark.parametrize("base_level", [0, 1, 2])
def test_a_turned_panorama_has_turned_keypoints(base_level: int) -> None:
    left = found_on_texture(base_level, 16, turned=False).turned(TURN)
    right = found_on_texture(base_level, 16, turned=True)
    agreement = Agreement(left, right)
    assert min(len(left), len(right)) > 900
    assert agreement.share > 0.7
    assert agreement.error_deg < 0.1
    assert agreement.size_ratio == pytest.approx(1, abs=0.01)
    assert agreement.size_spread < 0.03
    assert agreement.turn_deg < 3


def test_orb_too() -> None:
    left, right = (found_on_texture(1, 32, turned=turned, name="orb") for turned in (False, True))
    agreement = Agreement(left.turned(TURN), right)
    assert agreement.share > 0.75
    assert agreement.error_deg < 0.75  # a pixel
    assert agreement.size_ratio == pytest.approx(1, abs=0.01)
    assert agreement.turn_deg < 6
    assert right.descriptors.dtype == np.uint8


@pytest.mark.parametrize("base_level", [0, 1, 2])
def test_the_gnomonic_jacobian_is_the_derivative(base_level: int) -> None:
    grid = TangentGrid(base_level, 6, rotation=TURN)
    rng = np.random.default_rng(0)
    for face in (0, grid.num_images - 1):
        pixels = rng.uniform(-0.5, grid.dim - 0.5, (50, 2))

        def ray(pixels_xy: NDArray[np.float64], face: int = face) -> NDArray[np.float64]:
            homogeneous = np.column_stack([pixels_xy, np.ones(len(pixels_xy))])
            rays = homogeneous @ np.linalg.inv(grid.camera_matrix).T
            rays /= np.linalg.norm(rays, axis=1, keepdims=True)
            return np.asarray(rays @ grid.world_from_camera[face].T)

        numeric = np.stack(
            [(ray(pixels + 1e-5 * e) - ray(pixels - 1e-5 * e)) / 2e-5 for e in np.eye(2)], axis=-1
        )
        jacobian = gnomonic_jacobian(ray(pixels), grid, face)
        np.testing.assert_allclose(jacobian, numeric, atol=1e-9)
        plane = (pixels - (grid.dim - 1) / 2) * grid.pitch
        area = grid.pitch**2 * (1 + (plane**2).sum(axis=1)) ** -1.5
        found = np.linalg.norm(np.cross(jacobian[..., 0], jacobian[..., 1]), axis=1)
        np.testing.assert_allclose(found, area, rtol=1e-9)


@pytest.mark.parametrize("base_level", [0, 1, 2])
def test_every_keypoint_is_owned_by_its_image_and_there_once(base_level: int) -> None:
    points = found_on_texture(base_level, 16, turned=False)
    grid = TangentGrid(base_level, LEVEL)
    np.testing.assert_array_equal(grid.owners(points.directions_xyz), points.images)
    assert (np.diff(points.images) >= 0).all()
    assert len(np.unique(points.images)) > 0.8 * grid.num_images
    left, right = cKDTree(points.directions_xyz).query_pairs(grid.pitch, output_type="ndarray").T
    other_image = points.images[left] != points.images[right]
    ratio = np.abs(np.log(points.sizes_rad[left] / points.sizes_rad[right]))
    turn = angles_deg(points.orientations_xyz[left], points.orientations_xyz[right])
    assert not (other_image & (ratio < np.log(1.1)) & (turn < 15)).any()
    np.testing.assert_allclose(np.linalg.norm(points.directions_xyz, axis=1), 1)
    np.testing.assert_allclose(np.linalg.norm(points.orientations_xyz, axis=1), 1)
    inner = (points.directions_xyz * points.orientations_xyz).sum(axis=1)
    np.testing.assert_allclose(inner, 0, atol=1e-12)


def spots(grid: TangentGrid) -> NDArray[np.float64]:
    """Half a pixel beside the borders of cells, where two meet and where five or six do.

    Two are beside the poles, which are such corners, and two are on the seam at ±180°.
    """
    corners = icosphere(grid.base_level)[0][[0, 1, 4, 9, 6]]
    faces = np.linspace(0, grid.num_images - 1, 9).astype(int)[1:-1]
    others = np.argsort(grid.centers_xyz[faces] @ grid.centers_xyz.T, axis=1)[:, -2]
    sides = np.unique(grid.centers_xyz[faces] + grid.centers_xyz[others], axis=0)
    beside = np.concatenate([corners, sides])
    beside /= np.linalg.norm(beside, axis=1, keepdims=True)
    inwards = grid.centers_xyz[grid.owners(beside)] - beside
    beside += 0.5 * grid.pitch * inwards / np.linalg.norm(inwards, axis=1, keepdims=True)
    seam = lonlat_to_xyz(np.deg2rad([[180.0, 12.0], [-179.9, 40.0]]))
    return np.concatenate([beside / np.linalg.norm(beside, axis=1, keepdims=True), seam])


@pytest.mark.parametrize("base_level", [0, 1, 2])
def test_a_blob_is_found_at_its_place_and_by_its_owner_alone(base_level: int) -> None:
    """Of several widths: SIFT passes over some of those that lie between two of its scales."""
    grid = TangentGrid(base_level, LEVEL)
    centers = spots(grid)
    owners = grid.owners(centers)
    seen = np.zeros(len(centers), int)
    for sigma_deg in (1.6, 1.85, 2.1, 2.4):
        sigma = np.deg2rad(sigma_deg)
        found = detect_on_tangent_images(blobs(SHAPE, centers, sigma), grid, Detector(), 16)
        distance = angles_deg(found.directions_xyz[:, None], centers)
        near = distance.min(axis=1) < 3  # what is farther off is dark and between them
        found, distance = found.select(near), distance[near]
        nearest = distance.argmin(axis=1)
        assert distance.min(axis=1).max() < 0.15  # of a pixel of 1°
        np.testing.assert_array_equal(found.images, owners[nearest])
        # Where the DoG of a Gaussian is largest, see test_equirect.
        np.testing.assert_allclose(found.sizes_rad, 2 * sigma / 2 ** (1 / 6), rtol=0.06)
        seen += np.isin(np.arange(len(centers)), nearest)
    assert seen.min() >= 1
    assert seen.mean() > 3


def test_what_is_found_on_both_sides_of_a_border_is_kept_once() -> None:
    points = found_on_texture(2, 16, turned=False)
    _, first = np.unique(points.directions_xyz.round(2), axis=0, return_index=True)
    points = points.select(first[:40])
    # The same once more, from the next image, a fifth of a pixel away and a little weaker.
    pitch = TangentGrid(2, LEVEL).pitch
    near = points.directions_xyz + 0.2 * pitch * points.orientations_xyz
    double = SphericalKeypoints(
        near / np.linalg.norm(near, axis=1, keepdims=True),
        points.sizes_rad * np.float32(1.05),
        points.orientations_xyz,
        points.responses * np.float32(0.99),
        points.descriptors,
        points.images + np.int32(1),
    )
    both = SphericalKeypoints.concatenated([points, double])
    np.testing.assert_array_equal(_repeated(both, pitch), np.arange(80) >= 40)
    half_turn = SphericalKeypoints(**{**vars(double), "orientations_xyz": -points.orientations_xyz})
    larger = SphericalKeypoints(**{**vars(double), "sizes_rad": 2 * points.sizes_rad})
    same_image = SphericalKeypoints(**{**vars(double), "images": points.images})
    for others in (half_turn, larger, same_image):
        assert not _repeated(SphericalKeypoints.concatenated([points, others]), pitch).any()


def right_matches(left: SphericalKeypoints, right: SphericalKeypoints) -> int:
    """Keypoints whose most similar one of the turned panorama is within 1°."""
    a, b = (k.descriptors.astype(np.float64) for k in (left.turned(TURN), right))
    nearest = ((b**2).sum(axis=1) - 2 * a @ b.T).argmin(axis=1)
    angles = angles_deg(left.turned(TURN).directions_xyz, right.directions_xyz[nearest])
    return int((angles < 1).sum())


def test_a_margin_saves_what_borders_lose() -> None:
    none, some = (
        [found_on_texture(2, margin, turned=turned) for turned in (False, True)]
        for margin in (0, 16)
    )
    assert right_matches(*some) > 1.02 * right_matches(*none)
    # ORB looks at 31 pixels around a corner: without a margin nothing is left.
    corners = [len(found_on_texture(1, margin, turned=False, name="orb")) for margin in (0, 32)]
    assert corners[0] < 0.02 * corners[1]


@pytest.mark.parametrize("base_level", [0, 1])
def test_a_disc_has_one_size_in_the_middle_and_in_the_corner_of_an_image(base_level: int) -> None:
    """Closed form: the DoG of a disc of radius r is largest at r² / 2σ² = 2 ln k / (1 − k⁻²).

    Of several radii: SIFT passes over some of those that lie between two of its scales.
    """
    grid = TangentGrid(base_level, LEVEL)
    k = 2 ** (1 / 3)
    vertices = icosphere(base_level)[0]
    middle = grid.centers_xyz[1] + 0.3 * grid.pitch * grid.world_from_camera[1, :, 0]
    corner = vertices[(vertices @ grid.centers_xyz[1]).argmax()]
    corner = 0.95 * corner / np.linalg.norm(corner) + 0.05 * grid.centers_xyz[1]
    for place in (middle, corner):
        center = place / np.linalg.norm(place)
        ratios: list[float] = []
        for pixels in (2.6, 3.0, 3.4, 3.7, 4.1):
            columns, rows = gnomonic_jacobian(center[None], grid, 1)[0].T
            radius = pixels * np.sqrt(np.linalg.norm(np.cross(columns, rows)))
            found = detect_on_tangent_images(disc(SHAPE, center, radius), grid, Detector(), 16)
            near = found.select(angles_deg(found.directions_xyz, center) < 0.5)
            assert set(near.images) <= {1}
            ratios += [*near.sizes_rad / (2 * radius / np.sqrt(4 * np.log(k) / (1 - k**-2)))]
        assert len(ratios)
        np.testing.assert_allclose(ratios, 1.015, atol=0.03)


def test_turning_panorama_and_grid_together_changes_nothing() -> None:
    left = found_on_texture(1, 16, turned=False)
    grid = TangentGrid(1, LEVEL, rotation=TURN)
    right = detect_on_tangent_images(texture(SHAPE, TURN), grid, Detector(), 16)
    agreement = Agreement(left.turned(TURN), right)
    assert agreement.share > 0.85
    assert agreement.error_deg < 0.05


@pytest.mark.parametrize("threads", [1, 3])
def test_threads_change_nothing(threads: int) -> None:
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        again = detect_on_tangent_images(texture(SHAPE), TangentGrid(0, LEVEL), Detector(), 16)
    finally:
        torch.set_num_threads(before)
    for name, values in vars(found_on_texture(0, 16, turned=False)).items():
        np.testing.assert_array_equal(values, vars(again)[name])


def test_gray_and_colour_are_the_same_and_sizes_may_be_odd() -> None:
    image = texture((101, 177))
    grid = TangentGrid(0, 5, dim=29)
    gray = detect_on_tangent_images(image, grid, Detector(), margin=11)
    color = detect_on_tangent_images(
        np.repeat(image[..., None], 3, axis=2), grid, Detector(), margin=11
    )
    assert len(gray) > 50
    np.testing.assert_array_equal(gray.directions_xyz, color.directions_xyz)
    np.testing.assert_array_equal(gray.descriptors, color.descriptors)


@pytest.mark.parametrize("name", ["sift", "orb"])
def test_a_blank_panorama_has_none(name: str) -> None:
    found = detect_on_tangent_images(
        np.full((32, 64, 3), 9, np.uint8), TangentGrid(0, 4), Detector(name)
    )
    width, kind = (128, "float32") if name == "sift" else (32, "uint8")
    assert {key: (v.shape, str(v.dtype)) for key, v in vars(found).items()} == {
        "directions_xyz": ((0, 3), "float64"),
        "sizes_rad": ((0,), "float32"),
        "orientations_xyz": ((0, 3), "float64"),
        "responses": ((0,), "float32"),
        "descriptors": ((0, width), kind),
        "images": ((0,), "int32"),
    }


def test_the_limit_counts_the_whole_panorama() -> None:
    everything = found_on_texture(0, 16, turned=False)
    few = detect_on_tangent_images(
        texture(SHAPE), TangentGrid(0, LEVEL), Detector(max_keypoints=100), 16
    )
    assert len(few) == 100
    assert few.responses.min() >= np.sort(everything.responses)[-100]


@pytest.mark.parametrize(
    ("image", "margin", "message"),
    [
        (np.zeros((32, 64), np.float32), 4, "panorama: found dtype float32; expected uint8"),
        (np.zeros((32, 64, 2), np.uint8), 4, r"panorama: found shape \(32, 64, 2\)"),
        (np.zeros((32, 64), np.uint8), -1, "margin: found -1; expected 0 pixels or more"),
    ],
)
def test_what_cannot_work_is_refused(image: NDArray[Any], margin: int, message: str) -> None:
    with pytest.raises(SettingError, match=message):
        detect_on_tangent_images(image, TangentGrid(0, 4), Detector(), margin)
