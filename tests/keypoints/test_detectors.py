from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from tangent_train.errors import SettingError
from tangent_train.keypoints.detectors import Detections, Detector

_cv2: Any = cv2  # its types leave out the detectors
HAS_AKAZE = hasattr(cv2, "AKAZE_create") or hasattr(
    getattr(cv2, "xfeatures2d", None), "AKAZE_create"
)
NAMES = [
    "sift",
    "orb",
    pytest.param("akaze", marks=pytest.mark.skipif(not HAS_AKAZE, reason="OpenCV without AKAZE")),
]


def blobs(
    centers_xy: NDArray[np.float64], sigmas: NDArray[np.float64], size: tuple[int, int]
) -> NDArray[np.uint8]:
    y, x = np.mgrid[: size[0], : size[1]].astype(np.float64)
    grey = np.full(size, 60.0)
    for (cx, cy), sigma in zip(centers_xy, sigmas, strict=True):
        near = np.exp(-((x[0] - cx) ** 2) / (2 * sigma**2))
        grey += 150 * near * np.exp(-((y[:, :1] - cy) ** 2) / (2 * sigma**2))
    return np.rint(grey.clip(0, 255)).astype(np.uint8)


def scattered(seed: int, size: tuple[int, int]) -> NDArray[np.float64]:
    """Places at random fractions of a pixel, far from each other and the borders."""
    rng = np.random.default_rng(seed)
    places = np.empty((0, 2))
    for place in rng.uniform(50, np.array(size[::-1]) - 50, (600, 2)):
        if (np.hypot(*(places - place).T) > 42).all():
            places = np.vstack([places, place])
    return places


def errors(found: Detections, centers_xy: NDArray[np.float64], reach: float) -> Any:
    """``(n, 2)`` error, ``(n,)`` octave and place of what is within reach of a centre."""
    offsets = found.points_xy[:, None] - centers_xy
    nearest = np.linalg.norm(offsets, axis=-1).argmin(axis=1)
    error = offsets[np.arange(len(nearest)), nearest]
    near = np.linalg.norm(error, axis=1) < reach
    return error[near], found.octaves[near], found.points_xy[near], nearest[near]


@pytest.mark.parametrize("sigma", [1.5, 2.5, 4.0, 6.0])
@pytest.mark.parametrize("name", [NAMES[0], NAMES[2]])
def test_blobs_are_found_where_they_are(name: str, sigma: float) -> None:
    size = (401, 500)
    centers = scattered(0, size)
    found = Detector(name).detect(blobs(centers, np.full(len(centers), sigma), size))
    error, _, _, nearest = errors(found, centers, sigma)
    assert len(np.unique(nearest)) == len(centers)
    assert np.abs(error.mean(axis=0)).max() < 0.03
    assert np.median(np.linalg.norm(error, axis=1)) < 0.05


@pytest.mark.parametrize(("name", "border"), [("sift", 1.75), ("orb", 31)])
def test_nothing_is_found_near_borders(name: str, border: float) -> None:
    image = np.random.default_rng(0).integers(0, 256, (300, 321), np.uint8)
    image = cv2.normalize(cv2.GaussianBlur(image, (0, 0), 1), None, 0, 255, cv2.NORM_MINMAX)
    places = Detector(name).detect(image).points_xy
    nearest = min(places.min(), (np.array(image.shape[::-1]) - 1 - places).min())
    assert border <= nearest < border + 1


def test_opencvs_default_sift_is_off_by_a_quarter_of_a_pixel() -> None:
    size = (401, 500)
    centers = scattered(0, size)
    image = blobs(centers, np.full(len(centers), 2.5), size)
    points = np.array([point.pt for point in _cv2.SIFT_create().detect(image)])
    plain = (
        Detector().detect(image)._replace(points_xy=points, octaves=np.zeros(len(points), np.int32))
    )
    error, *_ = errors(plain, centers, 2.5)
    np.testing.assert_allclose(error.mean(axis=0), 0.25, atol=0.03)


def test_orbs_levels_are_where_they_belong() -> None:
    """Their pixels are 1.2, 1.44, … wide: on average nothing may be left of that, anywhere."""
    size = (611, 523)  # does not divide by the scales
    parts = []
    for seed in range(16):
        centers = scattered(seed, size)
        sigmas = np.random.default_rng(seed).uniform(1.5, 6, len(centers))
        image = blobs(centers, sigmas, size)
        found = Detector("orb").detect(image)
        plain = _cv2.ORB_create(2**24).detect(image)
        said = found._replace(points_xy=np.array([point.pt for point in plain]))
        parts.append((*errors(found, centers, 8)[:3], *errors(said, centers, 8)[:3]))
    error, octave, place, *opencv = map(np.concatenate, zip(*parts, strict=True))
    middle = (np.array(size[::-1]) - 1) / 2
    for level in range(8):
        mean, trend = _mean_and_trend(error[octave == level], place[octave == level] / middle - 1)
        assert np.abs(mean).max() < 0.15
        assert np.abs(trend).max() < 0.4
    error, octave, place = opencv
    mean, trend = _mean_and_trend(error[octave == 7], place[octave == 7] / middle - 1)
    assert (mean < -0.3).all()
    assert np.abs(trend).max() > 0.6


def _mean_and_trend(error: NDArray[np.float64], lever: NDArray[np.float64]) -> Any:
    """Mean, and how much more at the right and lower borders, in x and y."""
    return error.mean(axis=0), (error * lever).mean(axis=0) / (lever**2).mean(axis=0)


@pytest.mark.parametrize("name", NAMES)
def test_orientations_point_to_where_it_gets_brighter(name: str) -> None:
    y, x = np.mgrid[-70:71, -70:71].astype(np.float64)
    detector = Detector(name)
    for angle in np.linspace(-np.pi, np.pi, 13)[:-1] + 0.05:
        ramp = 128 + 0.9 * (x * np.cos(angle) + y * np.sin(angle))
        grey = ramp + 60 * np.exp(-(x**2 + y**2) / (2 * 2.5**2))
        found = detector.detect(np.rint(grey.clip(0, 255)).astype(np.uint8))
        central = found.select(np.linalg.norm(found.points_xy - 70, axis=1) < 2)
        assert len(central.angles_rad)
        off = np.angle(np.exp(1j * (central.angles_rad - angle)))
        assert np.abs(off).min() < np.deg2rad(12 if name == "akaze" else 8)


@pytest.mark.parametrize("name", NAMES)
def test_what_is_found_fits_together(name: str) -> None:
    image = np.random.default_rng(0).integers(0, 256, (120, 150), np.uint8)
    detector = Detector(name)
    found = detector.detect(image[:, ::-1])  # not contiguous
    count, width = found.descriptors.shape
    assert count > 10
    assert [len(values) for values in found] == [count] * 6
    kind, bits = ("float32", 128) if detector.norm == "l2" else ("uint8", 32)
    assert found.descriptors.dtype == kind
    assert width >= bits
    for blank in (np.full((90, 60), 128, np.uint8), np.zeros((1, 1), np.uint8)):
        none = detector.detect(blank)
        assert [len(values) for values in none] == [0] * 6
        assert none.points_xy.shape == (0, 2)
        assert none.descriptors.shape == (0, width)
        assert [values.dtype for values in none] == [values.dtype for values in found]


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("size", [(1, 300), (2, 9), (16, 16), (17, 40), (40, 5)])
def test_small_images_of_any_size(name: str, size: tuple[int, int]) -> None:
    image = np.random.default_rng(0).integers(0, 256, size, np.uint8)
    found = Detector(name).detect(image)
    assert (found.points_xy >= -0.5).all()
    assert (found.points_xy < np.array(size[::-1]) - 0.5).all()


@pytest.mark.parametrize("name", NAMES)
def test_threads_find_the_same(name: str) -> None:
    rng = np.random.default_rng(0)
    images = [rng.integers(0, 256, (100 + k, 90), np.uint8) for k in range(8)]
    detector = Detector(name)
    expected = [detector.detect(image) for image in images]
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(detector.detect, images))
    for left, right in zip(expected, found, strict=True):
        for a, b in zip(left, right, strict=True):
            np.testing.assert_array_equal(a, b)


def test_the_strongest_of_a_panorama_stay() -> None:
    responses = np.array([1, 9, 5, 5, 7], np.float32)
    octaves = np.zeros(5, np.int32)
    assert Detector(max_keypoints=3).strongest(responses, octaves).tolist() == [1, 2, 4]
    assert Detector(max_keypoints=5).strongest(responses, octaves).tolist() == [0, 1, 2, 3, 4]
    assert Detector().strongest(responses, octaves).tolist() == [0, 1, 2, 3, 4]
    none = Detector(max_keypoints=3).strongest(responses[:0], octaves[:0])
    assert none.tolist() == []


def test_orbs_levels_share_the_limit() -> None:
    """Shares 1 : ½ : ¼ of 14 are 8, 4, 2; responses of other levels do not count."""
    detector = Detector("orb", {"scaleFactor": 2.0, "nlevels": 3}, max_keypoints=14)
    octaves = np.repeat([0, 1, 2], 20).astype(np.int32)
    responses = np.concatenate([np.arange(20), 100 + np.arange(20), 200 + np.arange(20)])
    kept = detector.strongest(responses.astype(np.float32), octaves)
    assert kept.tolist() == [*range(12, 20), *range(36, 40), *range(58, 60)]
    # The coarsest level has but one: the finer ones take what it leaves, 9 and 4.
    kept = detector.strongest(responses[:41].astype(np.float32), octaves[:41])
    assert kept.tolist() == [*range(11, 20), *range(36, 40), 40]


def test_orb_keeps_all_corners_of_an_image() -> None:
    """Which are the strongest is known when all images are done."""
    image = np.random.default_rng(0).integers(0, 256, (300, 300), np.uint8)
    few, many = Detector("orb", max_keypoints=10), Detector("orb")
    assert len(few.detect(image).responses) == len(many.detect(image).responses) > 1000
    assert (few.limit, many.limit, Detector().limit) == (10, 10_000, None)


def test_options_reach_opencv() -> None:
    image = np.random.default_rng(0).integers(0, 256, (200, 200), np.uint8)
    image = cv2.GaussianBlur(image, (0, 0), 3)
    for name, option, value in (("sift", "contrastThreshold", 0.09), ("orb", "fastThreshold", 12)):
        strict = Detector(name, {option: value}).detect(image)
        loose = Detector(name, {option: 0.01 if name == "sift" else 3}).detect(image)
        assert len(strict.responses) < len(loose.responses)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("surf",), "detector: found 'surf'; expected one of sift, orb, akaze"),
        (("sift", {"nfeatures": 3}), "options of detector sift: found 'nfeatures'; expected some"),
        (("sift", {"sigma": 0.0}), "sigma of detector sift: found 0.0; expected a number from 1 "),
        (("sift", {"sigma": float("nan")}), "sigma of detector sift: found nan"),
        (("sift", {"sigma": "2"}), "sigma of detector sift: found '2'"),
        (("orb", {"nlevels": 0}), "nlevels of detector orb: found 0; expected a whole number fro"),
        (("orb", {"nlevels": 2.5}), "nlevels of detector orb: found 2.5"),
        (("orb", {"nlevels": True}), "nlevels of detector orb: found True"),
        (("sift", {}, 0), "max_keypoints: found 0; expected 1 or more"),
    ],
)
def test_settings_that_cannot_work(arguments: Any, message: str) -> None:
    with pytest.raises(SettingError) as raised:
        Detector(*arguments)
    assert message in str(raised.value)


def test_an_opencv_without_akaze_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    for place in (cv2, getattr(cv2, "xfeatures2d", None)):
        monkeypatch.delattr(place, "AKAZE_create", raising=False)
    with pytest.raises(SettingError, match=r"'akaze' with OpenCV .*'sift' or 'orb' with this"):
        Detector("akaze")


@pytest.mark.parametrize(
    "image", [np.zeros((9, 9)), np.zeros((9, 9, 3), np.uint8), np.zeros(9, np.uint8)]
)
def test_images_that_are_not_grey_bytes_are_refused(image: NDArray[Any]) -> None:
    with pytest.raises(SettingError, match="grey image: found shape"):
        Detector().detect(image)
