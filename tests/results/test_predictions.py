"""The files of predictions: their names, what they must not touch, and shares by solid angle."""

from __future__ import annotations

import csv
import json
import math
from pathlib import Path

import numpy as np
import pytest

from datamodules.images.gpano import area_of_crop
from datamodules.images.image_files import short_names
from tangent_train.geometry import camera_matrix_from_fov
from tangent_train.inference.views import InputImage
from tangent_train.results.predictions import Entry, PredictionFolder, class_shares

NAMES = ("unknown", "up", "down")


@pytest.mark.parametrize(
    ("paths", "names"),
    [
        (["photos/a.jpg"], ["a"]),
        (["p/x/a.jpg", "p/y/a.jpg"], ["x/a", "y/a"]),
        (["p/a.jpg", "p/a.png", "p/A.tif", "p/b.c.jpg"], ["a.jpg", "a.png", "A.tif", "b.c"]),
        (["p/q/a.jpg", "b.jpg"], ["p/q/a", "b"]),
        (["1.jpg", "1.png", "1.jpg.png"], ["1.jpg", "1.png", "1.jpg.png"]),
        (["a/x.jpg", "ab/x.jpg"], ["a/x", "ab/x"]),
    ],
)
def test_names_are_short_and_unlike(paths: list[str], names: list[str]) -> None:
    assert short_names([Path(path) for path in paths]) == names


def test_a_cap_has_its_solid_angle() -> None:
    image = InputImage(np.zeros((180, 360, 3), np.uint8))
    labels = np.full((180, 360), 2)
    labels[:30] = 1  # 60° to 90°: 2π (1 − sin 60°) of 4π
    cap = (1 - math.sin(math.pi / 3)) / 2
    assert class_shares(labels, NAMES, image)["up"] == pytest.approx(cap, abs=1e-9)
    area = area_of_crop((90, 180), [-90, 90, 0, 90])  # a quarter of the sphere
    shares = class_shares(labels[:90, :180], NAMES, image, area)
    assert shares == pytest.approx({"up": 2 * cap, "down": 1 - 2 * cap})


def test_pixels_of_photos_count_by_their_solid_angle() -> None:
    """Of 90°: ∫∫ (1 + x² + y²)^(−3/2) over a rectangle, by the arctangents of its corners."""
    size = (200, 200)
    image = InputImage(
        np.zeros((*size, 3), np.uint8), camera_matrix=camera_matrix_from_fov(90.0, size)
    )
    labels = np.ones(size, int)
    labels[:, 150:] = 2  # x from 1/2 to 1

    def quarter(x: float, y: float) -> float:
        return math.atan(x * y / math.sqrt(1 + x * x + y * y))

    part = 2 * (quarter(1, 1) - quarter(0.5, 1)) / (4 * quarter(1, 1))
    assert class_shares(labels, NAMES, image)["down"] == pytest.approx(part, rel=1e-3)


def test_the_summary(tmp_path: Path) -> None:
    entries: list[Entry] = [
        {
            "file": "a, b.jpg",
            "name": "a",
            "rows": 2,
            "columns": 4,
            "classes": {"up": 0.25, "down": 0.75},
        },
        {"file": "=x.jpg", "name": "x", "error": "=x.jpg: found nothing; expected an image."},
    ]
    folder = PredictionFolder(tmp_path, NAMES, ["labels"])
    folder.write_summary({"level": 6}, entries)
    assert folder.mean_shares(entries).rows == [["down", "75.0"], ["up", "25.0"]]
    content = json.loads((tmp_path / "summary.json").read_text())
    assert content == {"level": 6, "images": entries}
    assert json.loads((tmp_path / "classes.json").read_text()) == {"up": 1, "down": 2}
    with (tmp_path / "summary.csv").open(newline="") as file:
        first, second = csv.DictReader(file)
    assert (first["file"], first["up"], first["error"]) == ("a, b.jpg", "0.25", "")
    assert (second["file"], second["down"]) == ("'=x.jpg", "")
