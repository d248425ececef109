"""Structured3D: decoding, splits, cameras, and the 8 classes as published."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from datamodules.structured3d import CLASSES, Structured3D, Structured3DPerspective
from tangent_train.rendering import PerspectiveRepresentation
from tests.datamodules.data_files import names_of
from tests.datamodules.structured3d_format import HALF_ANGLES, write_structured3d


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_structured3d(tmp_path_factory.mktemp("structured3d"), photos=True)


def test_a_panorama_is_what_the_files_hold(root: Path, erp: Any) -> None:
    data = Structured3D(root, erp, inputs=["rgb", "depth"], lighting="coldlight")
    image = data.decode(data.splits()["test"][0])
    np.testing.assert_array_equal(image.labels[0], np.arange(64) % 41, "indices, not colors")
    assert (image.rgb[10:] == 102).all()
    assert data.class_names == ("unknown", *CLASSES)
    assert (CLASSES[0], CLASSES[21], CLASSES[39]) == ("wall", "ceiling", "other prop")
    assert image.depth is not None
    for number in range(41):
        expected = round(25 * number * 512 / 1000)
        assert set(image.depth[:, np.arange(64) % 41 == number].flat) == {expected}


@pytest.mark.parametrize(("classes", "stuff"), [("40", {1, 2, 8, 9, 22}), ("8", {1, 3, 4, 7, 8})])
def test_furniture_is_numbered(root: Path, erp: Any, classes: str, stuff: set[int]) -> None:
    """Number + 65536 label; files number furniture from 0, and 65535 is background."""
    data = Structured3D(root, erp, labels="panoptic", classes=classes)
    found = data.decode(data.splits()["test"][0]).labels
    labels = Structured3D(root, erp, classes=classes).decode(data.splits()["test"][0]).labels
    for (row, column), code in np.ndenumerate(found):
        label = int(labels[row, column])
        expected = 65536 * label + (0 if label in stuff else row)
        assert code == (expected if label and (row or label in stuff) else 0)


def test_splits_are_those_of_the_scenes(root: Path, erp: Any) -> None:
    data = Structured3D(root, erp)
    found = {split: [n[6:11] for n in names_of(data, split)] for split in ("train", "val", "test")}
    assert found == {
        "train": ["00000", "01155", "02999"],
        "val": ["03000", "03249"],
        "test": ["03250", "03398", "03499"],
    }
    assert names_of(data, "test")[0] == "scene_03250/3350"
    tested = Structured3D(root, erp, test_split="val", configuration="empty")
    assert [n[6:11] for n in names_of(tested, "test")] == found["val"]
    assert sorted(n[6:11] for s in ("train", "val") for n in names_of(tested, s)) == found["train"]


@pytest.mark.parametrize("invalid_scenes", ["keep", "leave_out"])
def test_invalid_scenes_and_missing_panoramas_are_reported(
    root: Path, erp: Any, invalid_scenes: Any
) -> None:
    problems, count = Structured3D(root, erp, invalid_scenes=invalid_scenes).check()
    first, *counts = problems.warnings
    assert "2 panoramas of scenes that the errata call invalid: 01155, 03398" in first
    assert len(counts) == (invalid_scenes == "keep")
    assert not counts or "18362 train, 1776 val, 1697 test" in counts[0]
    assert (count, problems.listed()) == (8 if counts else 6, [])


def test_a_photo_has_half_angles_and_z_depth(root: Path) -> None:
    crops = PerspectiveRepresentation(level=4, fov_deg=40)
    data = Structured3DPerspective(root, crops, inputs=["rgb", "depth"])
    photo = data.dataset("test").read(1)
    assert names_of(data, "test")[1] == "scene_03250/3350/1"
    focal = photo.camera_matrix[0, 0], photo.camera_matrix[1, 1]
    for length, half_angle in zip(focal, HALF_ANGLES, strict=True):
        assert math.atan(16 / length) == pytest.approx(half_angle)
    assert photo.camera_matrix[:2, 2].tolist() == [15.5, 15.5]
    ray = math.hypot(1, (31 - 15.5) / focal[0], (0 - 15.5) / focal[1])
    assert photo.depth[0, 31] == pytest.approx(0.512 * 25 * 31 * ray, abs=1)
    np.testing.assert_array_equal(photo.labels[0], np.arange(32))


KEY = {1: 6, 2: 3, 5: 1, 6: 4, 7: 5, 8: 2, 9: 7, 22: 0}


@pytest.mark.parametrize("others", [[], [3], [6], [3, 6], [4, 40]])
def test_published_8_classes_depend_on_the_other_classes_of_an_image(others: list[int]) -> None:
    numbers = np.array([[0, 1, 2, 5, 7, 8, 9, 22, *others]], np.uint8)
    right = [KEY.get(number, -1) + 1 for number in numbers[0].tolist()]
    np.testing.assert_array_equal(Structured3D.label_maps["8"].decode(numbers)[0], right)
    published = list(right)
    published[1] = 5 if 6 in others else 7  # wall becomes sofa
    published[2] = 0 if 3 in others else 4  # floor becomes unknown
    found = Structured3D.label_maps["published_s3d8"].decode(numbers)[0]
    np.testing.assert_array_equal(found, published)
    # The loop of the readers, number by number.
    looped = numbers[0].astype(int)
    for number in sorted(set(looped.tolist())):
        looped[looped == number] = KEY.get(number, -1)
    assert (looped + 1).tolist() == published
