"""Cityscapes: decoding, cameras, splits, refusals."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from torchvision.datasets import Cityscapes as Published

from datamodules.cityscapes import Cityscapes
from datamodules.core.files import SPLITS
from tangent_train.errors import DataError, SettingError
from tangent_train.rendering import PerspectiveRepresentation
from tests.datamodules import street_format as streets
from tests.datamodules.data_files import names_of, read_png

CROPS = PerspectiveRepresentation(level=6, dim=[16, 32])


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two photos of each city; not to be changed."""
    return streets.write_cityscapes(tmp_path_factory.mktemp("cityscapes"), each=2)


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return streets.write_cityscapes(tmp_path)


def photos(root: Path, representation: Any = CROPS, **settings: Any) -> Cityscapes:
    return Cityscapes(root, representation, **settings)


def test_every_id_has_its_published_class(shared: Path) -> None:
    data = photos(shared)
    labels = data.dataset("test").read(0).labels
    ids = read_png(next(shared.glob("gtFine/val/lindau/*0_gtFine_labelIds.png")))
    assert set(np.unique(ids)) == set(streets.IDS)
    names = {c.id: c.name for c in Published.classes if not c.ignore_in_eval}
    assert len(set(names.values())) == data.num_classes == 19
    for number in streets.IDS:
        expected = data.class_names.index(names.get(number, "unknown"))
        assert set(labels[ids == number]) == {expected}


def test_cameras_count_from_pixel_centers(shared: Path) -> None:
    photo = photos(shared).dataset("test").read(0)
    fx, fy, x, y = (value / 16 for value in streets.CAMERA.values())
    matrix: Any = [[fx, 0, x], [0, fy, y], [0, 0, 1]]
    np.testing.assert_allclose(photo.camera_matrix, matrix)
    assert photo.rgb.shape == (64, 128, 3)


def test_validation_takes_whole_training_cities(shared: Path) -> None:
    cities = {
        split: {name.partition("/")[0] for name in names_of(photos(shared), split)}
        for split in SPLITS
    }
    assert cities["test"] == {"lindau"}
    assert len(cities["val"]) == 1
    assert cities["val"] | cities["train"] == set(streets.CITIES["train"])
    assert len(names_of(photos(shared), "train")) == 4
    assert not names_of(photos(shared, val_fraction=0), "val")


def test_a_check_finds_missing_labels(root: Path) -> None:
    missing = root / "gtFine/train/aachen/aachen_000000_000000_gtFine_labelIds.png"
    missing.unlink()
    problems, count = photos(root).check()
    assert count == 4
    assert [problem.file for problem in problems.listed()] == [str(missing)]
    assert "found 3 train, 1 val; published are 2975 train, 500 val" in problems.warnings


def test_a_field_of_view_replaces_the_camera_files(root: Path) -> None:
    camera = root / "camera/train/ulm/ulm_000000_000000_camera.json"
    camera.write_text('{"intrinsic": {"fx": 0, "fy": 1, "u0": 5, "v0": 5}}')
    with pytest.raises(DataError, match=r"camera\.json: found intrinsic\.fx=0, .*data\.fov=48\.7"):
        photos(root).setup()
    shutil.rmtree(root / "camera")
    matrix = photos(root, fov=48.7).dataset("test").read(0).camera_matrix
    np.testing.assert_allclose(np.rad2deg(2 * np.arctan(64 / matrix[0, 0])), 48.7)


def test_square_crops_are_refused(root: Path) -> None:
    """A crop of 45° is higher than the photo, which is 26° high."""
    with pytest.raises(SettingError, match=r"spans .48.7, 25.47.°.*representation\.dim"):
        photos(root, PerspectiveRepresentation(level=6)).setup()
    photos(root, PerspectiveRepresentation(level=6, dim=[17, 32])).setup()


def test_crops_lower_than_wide_cover_the_photo_once(shared: Path) -> None:
    data = photos(shared)
    sample: Any = data.dataset("train")[0]
    assert sample.images[0].shape == (1, 16, 32, 3)
    evaluated: Any = data.dataset("test")[0]
    labels = data.dataset("test").read(0).labels
    share = (evaluated.labels > 0).sum() / (labels > 0).sum()
    crop_pixel = (2 * np.tan(np.deg2rad(22.5)) * streets.CAMERA["fx"] / 16 / 32) ** 2
    assert share * crop_pixel == pytest.approx(1, abs=0.05)
