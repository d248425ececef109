"""Shares of classes by solid angle."""

from __future__ import annotations

import csv
import json
import math
from typing import TYPE_CHECKING

import numpy as np
import pytest

from tangent_train.geometry import camera_matrix_from_fov
from tangent_train.inference.summary import class_shares, photo_solid_angles, write_summary

if TYPE_CHECKING:
    from pathlib import Path

NAMES = ("unknown", "up", "down")


def test_a_cap_has_its_solid_angle() -> None:
    height = 180
    labels = np.full((height, 360), 2)
    labels[:30] = 1  # 60° to 90°: 2π (1 − sin 60°) of 4π
    shares = class_shares(labels, NAMES)
    assert shares["up"] == pytest.approx((1 - math.sin(math.pi / 3)) / 2, abs=1e-9)
    assert sum(shares.values()) == pytest.approx(1)


def test_what_is_unknown_does_not_count() -> None:
    labels = np.zeros((20, 40), int)
    assert class_shares(labels, NAMES) == {"up": 0, "down": 0}
    labels[3, 5] = 2
    assert class_shares(labels, NAMES) == {"up": 0, "down": 1}


def test_a_photo_of_90_degrees_is_a_sixth_of_the_sphere() -> None:
    size = (200, 200)
    camera_matrix = camera_matrix_from_fov(90.0, size)
    total = sum(photo_solid_angles(camera_matrix, row, 200).sum() for row in range(200))
    assert total == pytest.approx(4 * math.pi / 6, rel=1e-4)
    labels = np.ones(size, int)
    labels[:, 150:] = 2

    # Columns from x = 1/2 to 1 on the plane: ∫∫ (1 + x² + y²)^(−3/2), by the arctangent of edges.
    def quarter(x: float, y: float) -> float:
        return math.atan(x * y / math.sqrt(1 + x * x + y * y))

    part = 2 * (quarter(1, 1) - quarter(0.5, 1))
    shares = class_shares(labels, NAMES, camera_matrix)
    assert shares["down"] == pytest.approx(part / (4 * math.pi / 6), rel=1e-3)


def test_files(tmp_path: Path) -> None:
    images = [
        {"file": "a, b.jpg", "rows": 2, "columns": 4, "level": 6, "views": 20,
         "seam_ratio": float("nan"), "classes": {"up": 0.25, "down": 0.75}},
        {"file": "broken.jpg", "error": "broken.jpg: found nothing; expected an image."},
    ]  # fmt: skip
    write_summary(tmp_path, {"level": 6, "images": images}, NAMES)
    content = json.loads((tmp_path / "summary.json").read_text())
    assert content["images"][0]["seam_ratio"] is None
    assert content["images"][1]["error"].startswith("broken.jpg")
    with (tmp_path / "summary.csv").open(newline="") as file:
        first, second = csv.DictReader(file)
    assert (first["file"], first["up"], first["seam_ratio"]) == ("a, b.jpg", "0.25", "")
    assert (second["down"], second["error"][:6]) == ("", "broken")
