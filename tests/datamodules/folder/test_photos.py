from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from datamodules.folder.labeled import FolderPhotos
from tangent_train.errors import DataError
from tangent_train.rendering import PerspectiveRepresentation
from tests.datamodules.folder.folder_format import CLASS_OF_STORED, write_classes
from tests.datamodules.folder.photo_format import displayed, write_cameras, write_photo

CROPS = PerspectiveRepresentation(level=4, fov_deg=20, dim=8)
K: list[list[float]] = [[70, 0, 30.5], [0, 72, 20], [0, 0, 1]]


def _photos(root: Path, **settings: Any) -> FolderPhotos:
    return FolderPhotos(root, CROPS, val_fraction=0, **settings)


def _only(root: Path, name: str, **settings: Any) -> Any:
    """A photo, of a data set with another one for training."""
    (root / "test.txt").write_text(name)
    return _photos(root, **settings).dataset("test").read(0)


def _found(root: Path, **settings: Any) -> list[tuple[str, str, str]]:
    """File, finding and remedy of all problems, as ``tangent-check`` lists them."""
    problems, _ = _photos(root, **settings).check()
    return [(Path(p.file).name, p.finding, p.remedy) for p in problems.listed()]


@pytest.fixture
def two(tmp_path: Path) -> Path:
    """Two photos of 48×64 without a focal length (0 is unknown), one of them for test."""
    write_classes(tmp_path)
    write_photo(tmp_path, "hall/a.png", 0, film_mm=None)
    write_photo(tmp_path, "hall/b.png", 1, film_mm=0)
    (tmp_path / "test.txt").write_text("hall/a")
    return tmp_path


# Pixels


@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
def test_pixels_are_those_that_are_displayed(tmp_path: Path, orientation: int) -> None:
    write_classes(tmp_path)
    write_photo(tmp_path, "a.png", 3, (50, 66), orientation=orientation)
    write_photo(tmp_path, "b.jpg", 4)
    photo = _only(tmp_path, "a")
    rgb, values = displayed(3, (50, 66))
    classes = np.zeros(256, np.uint8)
    classes[list(CLASS_OF_STORED)] = list(CLASS_OF_STORED.values())
    np.testing.assert_array_equal(photo.rgb, rgb)
    np.testing.assert_array_equal(photo.labels, classes[values])
    assert photo.depth is None


# Cameras


def test_the_nearest_camera_counts(tmp_path: Path) -> None:
    """Photo, folder, parent folder, all; then one field of view; then EXIF data."""
    write_classes(tmp_path)
    for seed, name in enumerate(("a/b/one", "a/b/two", "a/three", "four", "five")):
        write_photo(tmp_path, f"{name}.png", seed, (48, 72), film_mm=30)
    focal = {"a/b/one": 80, "a/b/": 90, "./a": 100}
    cameras = {name: {"fx": f, "fy": f + 1, "cx": 9, "cy": 8} for name, f in focal.items()}
    write_cameras(tmp_path, cameras)
    (tmp_path / "train.txt").write_text("five")

    def focal_lengths(**settings: Any) -> list[float]:
        source = _photos(tmp_path, **settings).dataset("test")
        by_name = {source.name(i): source.read(i).camera_matrix for i in range(len(source))}
        for name in ("a/b/one", "a/b/two", "a/three"):
            assert by_name[name][:2, 2].tolist() == [9, 8]
            assert by_name[name][1, 1] == by_name[name][0, 0] + 1
        return [by_name[name][0, 0] for name in ("a/b/one", "a/b/two", "a/three", "four")]

    assert focal_lengths() == pytest.approx([80, 90, 100, 72 * 30 / 36])
    assert focal_lengths(fov=60) == pytest.approx([80, 90, 100, 36 / math.tan(math.pi / 6)])
    write_cameras(tmp_path, cameras | {"": {"fx": 110, "fy": 110, "cx": 0, "cy": 0}})
    assert focal_lengths(fov=60) == [80, 90, 100, 110]


def test_a_camera_is_that_of_the_photo_as_displayed(tmp_path: Path) -> None:
    write_classes(tmp_path)
    write_photo(tmp_path, "a.jpg", 0, (60, 40), film_mm=36, orientation=6)
    write_photo(tmp_path, "b.jpg", 0)
    # Film upright is 24 mm wide; other shapes have its diagonal.
    assert _only(tmp_path, "a").camera_matrix[0, 0] == pytest.approx(40 * 36 / 24)
    focal = _only(tmp_path, "b").camera_matrix[0, 0]
    assert focal / 80 == pytest.approx(24 / math.hypot(36, 24))
    write_cameras(tmp_path, {"a": [[80, 0, 5], [0, 80, 55], [0, 0, 1]]})
    assert _only(tmp_path, "a").camera_matrix.tolist() == [[80, 0, 5], [0, 80, 55], [0, 0, 1]]
    write_cameras(tmp_path, {"a": [[80, 0, 55], [0, 80, 5], [0, 0, 1]]})
    message = r"a\.jpg: found cx = 55, cy = 5; .* inside 40 × 60 pixels"
    with pytest.raises(DataError, match=message):
        _photos(tmp_path).setup()


# Broken files


@pytest.mark.parametrize(
    "value",
    [
        [[70, 2, 30], [0, 72, 20], [0, 0, 1]],
        {"fx": 70, "fy": 72, "cx": 30, "cy": 20, "k1": 0.1},
    ],
)
def test_invalid_camera_matrices_are_refused(two: Path, value: Any) -> None:
    write_cameras(two, {"hall/a": value, ".": K})
    ((name, finding, _),) = _found(two, fov=70)
    assert name == "cameras.json"
    assert "hall/a" in finding
    assert "; expected an object of cameras by name" in finding
