from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from tangent_train.errors import SettingError
from tangent_train.geometry import lonlat_to_xyz, rotation_about
from tangent_train.keypoints.detectors import Detector
from tangent_train.keypoints.equirect import detect_on_equirect
from tests.keypoints.textures import Agreement, angles_deg, blobs, texture

SHAPE = (256, 512)


def distinct(directions_xyz: NDArray[np.float64], apart_deg: float) -> int:
    """Places, however many orientations were found at each."""
    left = directions_xyz
    count = 0
    while len(left):
        left = left[angles_deg(left, left[:1]) > apart_deg]
        count += 1
    return count


@pytest.mark.parametrize("columns", [64, 200, 256, 437])
def test_a_panorama_has_no_seam(columns: int) -> None:
    """Rolled, it has the same keypoints, rolled: at ±180° as anywhere else."""
    image = texture(SHAPE)
    detector = Detector()
    left = detect_on_equirect(image, detector).turned(
        rotation_about([0, 0, 1], columns / SHAPE[1] * 2 * np.pi)
    )
    right = detect_on_equirect(np.roll(image, columns, axis=1), detector)
    assert len(left) > 2000
    assert len(right) == pytest.approx(len(left), rel=0.01)
    agreement = Agreement(left, right)
    assert agreement.share > 0.99
    assert agreement.error_deg < 0.01
    near_seam = [np.abs(np.arctan2(k.directions_xyz[:, 1], -k.directions_xyz[:, 0])) < 0.05
                 for k in (left, right)]  # fmt: skip
    seam = Agreement(left.select(near_seam[0]), right)
    assert near_seam[0].sum() > 30
    assert seam.share > 0.95
    assert seam.error_deg < 0.01


@pytest.mark.parametrize("lon_deg", [180.0, 179.6, -179.8, 0.0, 90.2])
def test_a_blob_is_found_once_wherever_it_is(lon_deg: float) -> None:
    center = lonlat_to_xyz(np.deg2rad([lon_deg, 10.0]))
    for sigma_deg in (1.2, 4.0):
        sigma = np.deg2rad(sigma_deg)
        found = detect_on_equirect(blobs(SHAPE, center[None], sigma), Detector())
        assert distinct(found.directions_xyz, 2 * sigma_deg) == 1
        assert angles_deg(found.directions_xyz, center).max() < 0.03
        # Scale space: the DoG of a Gaussian blob of width s is largest at σ = s (k²: 2^⅔ → 2^⅓).
        np.testing.assert_allclose(found.sizes_rad, 2 * sigma / 2 ** (1 / 6), rtol=0.08)
        columns = found.equirect_pixels(SHAPE)[:, 0]
        assert ((columns >= -0.5) & (columns <= SHAPE[1] - 0.5)).all()


@pytest.mark.parametrize("lat_deg", [1.3, 40.0, -65.0])
def test_sizes_follow_the_area_of_the_pixels(lat_deg: float) -> None:
    """A blob, stretched as a panorama stretches it, has about the size it has on the sphere."""
    center = lonlat_to_xyz(np.deg2rad([30.0, lat_deg]))
    found = detect_on_equirect(blobs(SHAPE, center[None], np.deg2rad(2.5)), Detector())
    near = found.select(angles_deg(found.directions_xyz, center) < 1)
    expected = 2 * np.deg2rad(2.5) / 2 ** (1 / 6)
    ratio = near.sizes_rad / expected
    assert ratio.min() == pytest.approx(1, abs=0.25)


def test_gray_and_colour_are_the_same() -> None:
    image = texture((90, 200))
    gray = detect_on_equirect(image, Detector())
    color = detect_on_equirect(np.repeat(image[..., None], 3, axis=2), Detector())
    assert len(gray) > 50
    np.testing.assert_array_equal(gray.directions_xyz, color.directions_xyz)
    np.testing.assert_array_equal(gray.descriptors, color.descriptors)
    assert not gray.images.any()


@pytest.mark.parametrize("name", ["sift", "orb"])
@pytest.mark.parametrize("shape", [(1, 1), (7, 3), (64, 128), (64, 128, 3), (101, 77)])
def test_blank_panoramas_of_any_size_have_none(name: str, shape: tuple[int, ...]) -> None:
    found = detect_on_equirect(np.full(shape, 90, np.uint8), Detector(name))
    expected = {
        "directions_xyz": ((0, 3), "float64"),
        "sizes_rad": ((0,), "float32"),
        "orientations_xyz": ((0, 3), "float64"),
        "responses": ((0,), "float32"),
        "descriptors": ((0, 128), "float32") if name == "sift" else ((0, 32), "uint8"),
        "images": ((0,), "int32"),
    }
    assert {key: (v.shape, str(v.dtype)) for key, v in vars(found).items()} == expected


def test_the_limit_takes_the_strongest_of_the_panorama() -> None:
    image = texture((90, 200))
    everything = detect_on_equirect(image, Detector())
    few = detect_on_equirect(image, Detector(max_keypoints=20))
    assert len(few) == 20
    assert few.responses.min() >= np.sort(everything.responses)[-20]


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (np.zeros((8, 16), np.float32), "panorama: found dtype float32; expected uint8"),
        (np.zeros((8, 16), np.uint16), "panorama: found dtype uint16; expected uint8"),
        (np.zeros((8, 16, 4), np.uint8), r"panorama: found shape \(8, 16, 4\); expected \(H, W\)"),
        (np.zeros((8, 0), np.uint8), r"panorama: found shape \(8, 0\)"),
        (np.zeros(8, np.uint8), r"panorama: found shape \(8,\)"),
    ],
)
def test_what_is_no_panorama_is_refused(image: NDArray[Any], message: str) -> None:
    with pytest.raises(SettingError, match=message):
        detect_on_equirect(image, Detector())
