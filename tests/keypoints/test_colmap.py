"""Files for COLMAP, read back by COLMAP, which also reconstructs the cameras from them."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

from tangent_train.errors import SettingError
from tangent_train.geometry import FLIP_Y, PanoramaPose, lonlat_to_xyz, random_rotation
from tangent_train.keypoints.colmap import (
    ColmapImage,
    ColmapPair,
    write_colmap_database,
    write_colmap_text,
)
from tangent_train.keypoints.detectors import Detector
from tangent_train.keypoints.equirect import detect_on_equirect
from tangent_train.keypoints.motion_search import CAMERA_FROM_PANORAMA
from tangent_train.keypoints.spherical import SphericalKeypoints
from tangent_train.keypoints.two_view import TwoView, estimate_two_view
from tests.keypoints.scenes import unit

needs_pycolmap = pytest.mark.skipif(
    importlib.util.find_spec("pycolmap") is None, reason="pycolmap is not installed"
)
NO_MATCHES = np.empty((0, 2), np.int64)


def keypoints(directions_xyz: NDArray[np.float64], *, bits: bool = False) -> SphericalKeypoints:
    """Keypoints of 2° in these directions, their orientation to the right."""
    n = len(directions_xyz)
    rng = np.random.default_rng(n)
    x, y, _ = directions_xyz.T
    right = np.stack([-y, x, 0 * x], axis=-1) / np.maximum(np.hypot(x, y), 1e-9)[:, None]
    descriptors: Any = rng.integers(0, 256, (n, 32 if bits else 128))
    return SphericalKeypoints(
        directions_xyz,
        np.full(n, np.radians(2), np.float32),
        right,
        np.ones(n, np.float32),
        descriptors.astype(np.uint8 if bits else np.float32),
        np.zeros(n, np.int32),
    )


def some(n: int, seed: int = 0) -> NDArray[np.float64]:
    return unit(np.random.default_rng(seed).normal(size=(n, 3)))


@contextmanager
def opened(path: Path) -> Iterator[Any]:
    import pycolmap

    database = pycolmap.Database.open(path)
    yield database
    database.close()


class Walk(NamedTuple):
    """Panoramas of the same points."""

    poses: list[PanoramaPose]
    images: list[ColmapImage]
    pairs: list[ColmapPair]


def walk(count: int) -> Walk:
    rng = np.random.default_rng(3)
    points_m = some(250, 4) * rng.uniform(1.5, 5, (250, 1))
    poses, images, places = [], [], []
    for number in range(count):
        pose = PanoramaPose(random_rotation(rng) @ FLIP_Y, rng.normal(size=3) * 0.6)
        order = rng.permutation(250)
        seen = unit(pose.seen(points_m[order])[0] + rng.normal(size=(250, 3)) * 3e-4)
        poses.append(pose)
        places.append(np.argsort(order))
        images.append(ColmapImage(f"room a/{number}.png", (512, 1024), keypoints(seen)))
    pairs = []
    for left in range(count):
        for right in range(left):  # the order of names and of images differ
            matches = np.stack([places[left], places[right]], axis=1)
            first, second = (
                images[side].keypoints.directions_xyz[matches[:, column]]
                for column, side in enumerate((left, right))
            )
            pairs.append(
                ColmapPair(
                    images[left].name, images[right].name, matches, estimate_two_view(first, second)
                )
            )
    return Walk(poses, images, pairs)


def test_text_of_known_keypoints(tmp_path: Path) -> None:
    # The middle of the image, a quarter to the right, near the right border, and near the top.
    lonlat = np.radians([(0, 0), (90, -45), (179.9, 10), (20, 89)])
    image = ColmapImage("room/a.png", (100, 200), keypoints(lonlat_to_xyz(lonlat)))
    (path,) = write_colmap_text(tmp_path, [image])
    assert path == tmp_path / "room" / "a.png.txt"
    header, *lines = path.read_text().splitlines()
    assert header == "4 128"
    numbers = np.array([line.split() for line in lines], np.float64)
    assert numbers.shape == (4, 4 + 128)
    # Corner-origin pixels: x = (λ + 180) / 360 · W, y = (90 − φ) / 180 · H.
    np.testing.assert_allclose(
        numbers[:, :2], [(100, 50), (150, 75), (199.9444, 44.4444), (111.1111, 0.5556)], atol=1e-4
    )
    # 2° are 100/90 pixels; the area of a pixel shrinks with cos φ; the scale is half of the size.
    expected = 100 / 90 / 2 / np.sqrt(np.cos(lonlat[:, 1]))
    np.testing.assert_allclose(numbers[:, 2], expected, atol=1e-4)
    np.testing.assert_allclose(numbers[:, 3], 0, atol=1e-5)
    np.testing.assert_array_equal(numbers[:, 4:], image.keypoints.descriptors)


def test_pixels_are_half_a_pixel_from_opencvs(tmp_path: Path) -> None:
    # A blob at the centre of pixel (60, 40), of σ = 3: COLMAP's place is (60.5, 40.5).
    v, u = np.mgrid[:100, :200]
    blob = (255 * np.exp(-((u - 60) ** 2 + (v - 40) ** 2) / 18)).astype(np.uint8)
    found = detect_on_equirect(blob, Detector("sift"))
    strongest = found.select([int(np.argmax(found.responses))])
    (path,) = write_colmap_text(tmp_path, [ColmapImage("blob", (100, 200), strongest)])
    x, y, scale = map(float, path.read_text().splitlines()[1].split()[:3])
    assert (x, y) == pytest.approx((60.5, 40.5), abs=0.05)
    assert scale == pytest.approx(3, rel=0.25)


def test_list_of_matches(tmp_path: Path) -> None:
    images = [ColmapImage(name, (50, 100), keypoints(some(5))) for name in ("a.png", "b.png", "c")]
    pairs = [
        ColmapPair("b.png", "a.png", np.array([(0, 4), (3, 1)])),
        ColmapPair("a.png", "c", NO_MATCHES),
    ]
    files = write_colmap_text(tmp_path, images, pairs)
    assert [path.name for path in files] == ["a.png.txt", "b.png.txt", "c.txt", "matches.txt"]
    assert files[-1].read_text() == "b.png a.png\n0 4\n3 1\n\na.png c\n\n"
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(path.name for path in files)


@needs_pycolmap
def test_a_database_as_colmap_reads_it(tmp_path: Path) -> None:
    import pycolmap

    path = tmp_path / "new folder" / "rooms.db"
    _, images, pairs = walk(3)
    wide = ColmapImage("ü wide.jpg", (100, 300), keypoints(some(7), bits=True))
    write_colmap_database(path, [*images, wide], pairs)
    assert [file.name for file in path.parent.iterdir()] == ["rooms.db"]
    with opened(path) as database:
        by_name = {image.name: image for image in database.read_all_images()}
        assert set(by_name) == {image.name for image in (*images, wide)}
        assert database.num_cameras() == database.num_rigs() == 2
        assert database.num_frames() == 4
        for image in (*images, wide):
            stored = by_name[image.name]
            camera = database.read_camera(stored.camera_id)
            assert camera.model_name == "EQUIRECTANGULAR"
            assert (camera.height, camera.width) == image.shape
            check_keypoints(database, stored.image_id, camera, image)
        descriptors = database.read_descriptors(by_name[images[0].name].image_id)
        assert descriptors.type == pycolmap.FeatureExtractorType.SIFT
        np.testing.assert_array_equal(descriptors.data, images[0].keypoints.descriptors)
        assert not database.exists_descriptors(by_name[wide.name].image_id)
        for pair in pairs:
            check_pair(database, by_name, pair)


def check_keypoints(database: Any, image_id: int, camera: Any, image: ColmapImage) -> None:
    stored = database.read_keypoints(image_id)
    assert stored.shape == (len(image.keypoints), 4)
    # COLMAP's own rays of these pixels are the keypoints' directions.
    rays = camera.cam_ray_from_img(stored[:, :2].astype(np.float64))
    np.testing.assert_allclose(
        rays @ CAMERA_FROM_PANORAMA, image.keypoints.directions_xyz, atol=1e-5
    )


def check_pair(database: Any, by_name: dict[str, Any], pair: ColmapPair) -> None:
    ids = by_name[pair.left].image_id, by_name[pair.right].image_id
    np.testing.assert_array_equal(database.read_matches(*ids), pair.matches)
    geometry = database.read_two_view_geometry(*ids)
    two_view = pair.two_view
    assert two_view is not None
    assert two_view.rotation is not None
    assert two_view.translation is not None
    assert two_view.essential is not None
    np.testing.assert_array_equal(geometry.inlier_matches, pair.matches[two_view.inliers])
    import pycolmap

    assert geometry.config == pycolmap.TwoViewGeometryConfiguration.CALIBRATED.value
    motion = geometry.cam2_from_cam1
    axes = CAMERA_FROM_PANORAMA
    np.testing.assert_allclose(axes.T @ motion.rotation.matrix() @ axes, two_view.rotation)
    np.testing.assert_allclose(axes.T @ motion.translation, two_view.translation, atol=1e-12)
    essential = axes.T @ geometry.E @ axes
    scale = np.sign((essential * two_view.essential).sum())
    np.testing.assert_allclose(essential * scale, two_view.essential, atol=1e-9)


@needs_pycolmap
def test_colmap_reconstructs_the_cameras(tmp_path: Path) -> None:
    import pycolmap

    poses, images, pairs = walk(4)
    write_colmap_database(tmp_path / "rooms.db", images, pairs)
    for folder in ("images", "model"):
        (tmp_path / folder).mkdir()
    options = pycolmap.IncrementalPipelineOptions()
    options.min_model_size = 3
    options.num_threads = 1
    options.extract_colors = False
    pycolmap.logging.minloglevel = 2
    models = pycolmap.incremental_mapping(
        tmp_path / "rooms.db", tmp_path / "images", tmp_path / "model", options
    )
    assert len(models) == 1
    assert models[0].num_reg_images() == 4
    found_m = np.array(
        [models[0].find_image_with_name(image.name).projection_center() for image in images]
    )
    true_m = np.array([pose.location_m for pose in poses])
    edges = [places[1:] - places[0] for places in (found_m, true_m)]
    scale = np.cbrt(np.linalg.det(edges[0]) / np.linalg.det(edges[1]))
    assert scale > 0  # not mirrored
    lengths = [np.linalg.norm(p[:, None] - p[None], axis=-1) for p in (found_m / scale, true_m)]
    np.testing.assert_allclose(lengths[0], lengths[1], atol=0.01)


@needs_pycolmap
@pytest.mark.parametrize(("kind", "config"), [("rotation", "PANORAMIC"), ("none", "DEGENERATE")])
def test_pairs_without_translation(tmp_path: Path, kind: Any, config: str) -> None:
    import pycolmap

    images = [ColmapImage(name, (50, 100), keypoints(some(9))) for name in "ab"]
    turn = random_rotation(np.random.default_rng(1))
    two_view = TwoView(
        kind,
        np.full(9, kind == "rotation"),
        np.zeros(9),
        turn if kind == "rotation" else None,
        None,
    )
    matches = np.stack([np.arange(9), np.arange(9)], axis=1)
    path = tmp_path / "pair.db"
    write_colmap_database(path, images, [ColmapPair("a", "b", matches, two_view)])
    with opened(path) as database:
        geometry = database.read_two_view_geometry(1, 2)
        expected = getattr(pycolmap.TwoViewGeometryConfiguration, config)
        assert geometry.config == expected.value
        assert len(geometry.inlier_matches) == (9 if kind == "rotation" else 0)
        if kind == "rotation":
            motion = geometry.cam2_from_cam1
            np.testing.assert_array_equal(motion.translation, 0)
            axes = CAMERA_FROM_PANORAMA
            np.testing.assert_allclose(axes.T @ motion.rotation.matrix() @ axes, turn)


@needs_pycolmap
def test_matches_without_a_geometry(tmp_path: Path) -> None:
    images = [ColmapImage(name, (50, 100), keypoints(some(9))) for name in "ab"]
    matches = np.array([(0, 8), (7, 1)])
    write_colmap_database(tmp_path / "pair.db", images, [ColmapPair("a", "b", matches)])
    with opened(tmp_path / "pair.db") as database:
        np.testing.assert_array_equal(database.read_matches(1, 2), matches)
        assert database.num_inlier_matches() == 0


@needs_pycolmap
def test_no_keypoints(tmp_path: Path) -> None:
    images = [ColmapImage(name, (50, 100), keypoints(some(0))) for name in "ab"]
    pairs = [ColmapPair("a", "b", NO_MATCHES, estimate_two_view(some(0), some(0)))]
    write_colmap_database(tmp_path / "empty.db", images, pairs)
    with opened(tmp_path / "empty.db") as database:
        assert database.num_keypoints() == 0
        assert database.num_images() == 2
    files = write_colmap_text(tmp_path, images, pairs)
    assert files[0].read_text() == "0 128\n"
    assert files[-1].read_text() == "a b\n\n"


@needs_pycolmap
def test_nothing_is_overwritten_unasked(tmp_path: Path) -> None:
    images = [ColmapImage(name, (50, 100), keypoints(some(3))) for name in "ab"]
    path = tmp_path / "mine.db"
    path.write_text("precious")
    (tmp_path / "b.txt").write_text("precious")
    with pytest.raises(SettingError, match=r"mine\.db, which is there already"):
        write_colmap_database(path, images)
    with pytest.raises(SettingError, match=r"b\.txt, which is there already"):
        write_colmap_text(tmp_path, images)
    assert path.read_text() == (tmp_path / "b.txt").read_text() == "precious"
    assert sorted(file.name for file in tmp_path.iterdir()) == ["b.txt", "mine.db"]
    write_colmap_database(path, images, overwrite=True)
    write_colmap_text(tmp_path, images, overwrite=True)
    assert (tmp_path / "b.txt").read_text().startswith("3 128\n")
    with opened(path) as database:
        assert database.num_images() == 2


@needs_pycolmap
def test_a_failure_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object) -> None:
        raise OSError("no room")

    monkeypatch.setattr("tangent_train.keypoints.colmap._write_image", broken)
    with pytest.raises(OSError, match="no room"):
        write_colmap_database(tmp_path / "a.db", [ColmapImage("a", (5, 10), keypoints(some(1)))])
    assert list(tmp_path.iterdir()) == []


def images_named(*names: str) -> list[ColmapImage]:
    return [ColmapImage(name, (50, 100), keypoints(some(3))) for name in names]


@pytest.mark.parametrize(
    ("names", "pair", "message"),
    [
        (("a", "a"), None, "same name twice"),
        (("../a",), None, "relative file name"),
        (("/a",), None, "relative file name"),
        (("",), None, "relative file name"),
        (("a\nb",), None, "relative file name"),
        (("a", "b"), ColmapPair("a", "c", NO_MATCHES), "two of the images"),
        (("a", "b"), ColmapPair("a", "a", NO_MATCHES), "two of the images"),
        (("a", "b"), ColmapPair("a", "b", np.array([(0, 3)])), "not there"),
        (("a", "b"), ColmapPair("a", "b", np.array([(-1, 0)])), "not there"),
        (
            ("a", "b"),
            ColmapPair("a", "b", np.array([(0, 0)]), estimate_two_view(some(2), some(2))),
            "the geometry of 2 matches",
        ),
    ],
)
def test_what_cannot_be_written(
    tmp_path: Path, names: tuple[str, ...], pair: ColmapPair | None, message: str
) -> None:
    pairs = [] if pair is None else [pair]
    for write, path in ((write_colmap_text, tmp_path), (write_colmap_database, tmp_path / "a.db")):
        with pytest.raises(SettingError, match=message):
            write(path, images_named(*names), pairs)
    assert list(tmp_path.iterdir()) == []


def test_pairs_are_written_once(tmp_path: Path) -> None:
    twice = [ColmapPair("a", "b", NO_MATCHES), ColmapPair("b", "a", NO_MATCHES)]
    with pytest.raises(SettingError, match="same pair twice"):
        write_colmap_text(tmp_path, images_named("a", "b"), twice)


def test_what_only_a_database_can_hold(tmp_path: Path) -> None:
    pair = [ColmapPair("a b", "c", NO_MATCHES)]
    with pytest.raises(SettingError, match="without spaces"):
        write_colmap_text(tmp_path, images_named("a b", "c"), pair)
    write_colmap_text(tmp_path / "features", images_named("a b", "c"))
    bits = [*images_named("a"), ColmapImage("b", (50, 100), keypoints(some(3), bits=True))]
    with pytest.raises(SettingError, match="32 uint8 numbers; expected SIFT's 128"):
        write_colmap_text(tmp_path / "bits", bits)
    assert not (tmp_path / "bits").exists()
    with pytest.raises(SettingError, match="one named matches"):
        write_colmap_text(
            tmp_path, images_named("matches", "c"), [ColmapPair("matches", "c", NO_MATCHES)]
        )


def test_a_missing_pycolmap_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    with pytest.raises(SettingError, match=r"pip install 'tangent-train\[keypoints\]'"):
        write_colmap_database(tmp_path / "a.db", images_named("a"))
    write_colmap_text(tmp_path, images_named("a"))  # needs none
