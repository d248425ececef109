"""Predictions: names of their files, and shares by solid angle."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from datamodules.core.label_map import read_label_map
from datamodules.folder.class_masks import class_masks
from tangent_train.geometry import camera_matrix_from_fov
from tangent_train.heads import ClassesHead, PredictedImage
from tangent_train.inference.images import InputImage
from tangent_train.io.gpano import read_area
from tangent_train.io.image_files import short_names
from tangent_train.io.pixel_files import write_pixels
from tangent_train.results.predictions import PredictionFolder

NAMES = ("unknown", "up", "down")


@pytest.mark.parametrize(
    ("paths", "names"),
    [
        (["p/a.jpg", "p/a.png", "p/A.tif", "p/b.c.jpg"], ["a.jpg", "a.png", "A.tif", "b.c"]),
        (["p/q/a.jpg", "b.jpg"], ["p/q/a", "b"]),
        (["1.jpg", "1.png", "1.jpg.png"], ["1.jpg", "1.png", "1.jpg.png"]),
        (["a/x.jpg", "ab/x.jpg"], ["a/x", "ab/x"]),
    ],
)
def test_names_are_short_and_unlike(paths: list[str], names: list[str]) -> None:
    assert short_names([Path(path) for path in paths]) == names


def test_names_are_relative_to_a_folder(tmp_path: Path) -> None:
    """With images in one subfolder only, too; of a pattern, to the common folder."""
    (tmp_path / "train" / "berlin").mkdir(parents=True)
    paths = [tmp_path / "train" / "berlin" / f"{n}.png" for n in (1, 2)]
    assert short_names(paths, tmp_path / "train" / ".." / "train") == ["berlin/1", "berlin/2"]
    assert short_names(paths, tmp_path / "train" / "*" / "*.png") == ["1", "2"]


def test_classes_of_one_name_are_read_back_as_one(tmp_path: Path) -> None:
    """By data=folder and mask_classes=: they had kept the last of its labels."""
    names = ("unknown", "door", "wall", "door", "u\u0308", "unknown", "Wall", "ü")
    PredictionFolder(tmp_path, ClassesHead(names), ["labels"]).write_summary({}, [])
    labels = np.array([list(range(8))] * 4, np.uint8)
    write_pixels(tmp_path / "labels" / "a.png", labels)
    classes = read_label_map(tmp_path / "classes.json")
    assert classes.names == ("door", "wall", "ü", "Wall")
    assert classes.decode(labels)[0].tolist() == [0, 1, 2, 1, 3, 0, 4, 3]
    area = read_area(Path("image"), (4, 8))
    for ignored, masked in ((["door", "Wall"], [1, 3, 6]), (["u\u0308"], [4, 7])):
        counts = class_masks(tmp_path, ignored).read("a", area)
        assert np.flatnonzero(counts[0] == 0).tolist() == masked


def test_a_cap_of_a_crop_has_its_solid_angle() -> None:
    labels = np.full((90, 180), 2)
    labels[:30] = 1  # 60° to 90°: 2π (1 − sin 60°) of 4π
    labels[60:] = 0  # below 30°: half of it
    cap = (1 - math.sin(math.pi / 3)) / 2
    area = read_area(Path("image"), (90, 180), [-90, 90, 0, 90])  # a quarter of the sphere
    image = InputImage(np.zeros((180, 360, 3), np.uint8), area=area)
    shares = ClassesHead(NAMES).summarize(PredictedImage(image, labels), np.array(True))
    assert shares == pytest.approx({NAMES[0]: 0.5, "up": 2 * cap, "down": 0.5 - 2 * cap})


def test_pixels_of_photos_count_by_their_solid_angle() -> None:
    """A photo of 90°: ∫∫ (1 + x² + y²)^(−3/2) over a rectangle, by arctangents of its corners."""
    size = (200, 200)
    image = InputImage(
        np.zeros((*size, 3), np.uint8), camera_matrix=camera_matrix_from_fov(90.0, size)
    )
    labels = np.ones(size, int)
    labels[:, 150:] = 2  # x from 1/2 to 1

    def quarter(x: float, y: float) -> float:
        return math.atan(x * y / math.sqrt(1 + x * x + y * y))

    part = 2 * (quarter(1, 1) - quarter(0.5, 1)) / (4 * quarter(1, 1))
    shares = ClassesHead(NAMES).summarize(PredictedImage(image, labels), np.array(True))
    assert shares["down"] == pytest.approx(part, rel=1e-3)
