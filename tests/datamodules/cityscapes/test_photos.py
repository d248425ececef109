"""Cityscapes: decoding, cameras, splits, refusals."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from torchvision.datasets import Cityscapes as Published

from datamodules import Cityscapes
from datamodules.core.splits import SPLITS
from tangent_train.errors import DataError, SettingError
from tangent_train.rendering import PerspectiveRepresentation
from tests.datamodules.cityscapes import street_format as streets
from tests.datamodules.data_files import names_of, read_png, write_png

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
    np.testing.assert_array_equal(data.dataset("test").labels(0), labels)


def test_cameras_count_from_pixel_centers(shared: Path) -> None:
    photo = photos(shared).dataset("test").read(0)
    fx, fy, x, y = (value / 16 for value in streets.CAMERA.values())
    K = np.array([[fx, 0, x], [0, fy, y], [0, 0, 1]])
    np.testing.assert_allclose(photo.camera_matrix, K)
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
    assert "ulm/000000_000001" in names_of(photos(shared, val_fraction=0), "train")
    assert not names_of(photos(shared, val_fraction=0), "val")


def test_a_check_counts_and_finds_strays_and_missing_labels(root: Path) -> None:
    write_png(root / "gtFine/train/ulm/ulm_9_gtFine_labelIds.png", np.ones((64, 128), np.uint8))
    missing = root / "gtFine/train/aachen/aachen_000000_000000_gtFine_labelIds.png"
    missing.unlink()
    problems, count = photos(root).check()
    assert count == 4
    assert [problem.file for problem in problems.listed()] == [str(missing)]
    assert sorted(problems.warnings) == [
        "found 3 train, 1 val; published are 2975 train, 500 val",
        f"label images: 1 without an image, e.g. {root}/gtFine/train/ulm/ulm_9_gtFine_labelIds.png",
    ]


def test_dummy_labels_are_refused(root: Path) -> None:
    """Labels of the test images, copied to those of val to be scored."""
    for kind in ("leftImg8bit", "gtFine", "camera"):
        shutil.copytree(root / kind / "test", root / kind / "val", dirs_exist_ok=True)
    problems, _ = photos(root).check()
    (problem,) = problems.listed()
    assert "berlin_000000_000000_gtFine_labelIds.png: found no pixel with a class" in str(
        problem.error
    )
    assert "dummies" in problem.remedy


def test_other_label_images_are_refused(root: Path) -> None:
    for number, image in enumerate((np.full((64, 128), 34), np.ones((64, 128, 3)))):
        city = streets.CITIES["train"][number]
        path = root / f"gtFine/train/{city}/{city}_000000_000000_gtFine_labelIds.png"
        write_png(path, image.astype(np.uint8))
    texts = [str(problem.error) for problem in photos(root).check()[0].listed()]
    assert len(texts) == 2
    assert "found numbers 34; expected 0, 1, 2" in texts[0]
    assert "further numbers in its number_table" in texts[0]
    assert "found 8-bit RGB; expected 8-bit gray or palette" in texts[1]


def test_without_camera_files_a_field_of_view_is_needed(root: Path) -> None:
    shutil.rmtree(root / "camera")
    with pytest.raises(DataError, match=r"camera/train: found no such folder.*data\.fov=48\.7"):
        photos(root).setup()
    matrix = photos(root, fov=48.7).dataset("test").read(0).camera_matrix
    np.testing.assert_allclose(np.rad2deg(2 * np.arctan(64 / matrix[0, 0])), 48.7)


@pytest.mark.parametrize(
    ("content", "found"),
    [
        ('{"intrinsic": {"fx": 1, "fy": 1, "u0": 5}}', "no v0 in intrinsic"),
        ('{"intrinsic": {"fx": 0, "fy": 1, "u0": 5, "v0": 5}}', "fx=0"),
        ('{"intrinsic": {"fx": 140, "fy": 140, "u0": 1096.98, "v0": 5}}', r"u0=1096\.98"),
        ("{}", "no intrinsic inside"),
        ("", "Expecting value"),
    ],
)
def test_broken_cameras_are_refused(root: Path, content: str, found: str) -> None:
    path = root / "camera/train/ulm/ulm_000000_000000_camera.json"
    path.write_text(content)
    with pytest.raises(DataError, match=rf"ulm_000000_000000_camera\.json: found .*{found}"):
        photos(root).setup()


def test_square_crops_are_refused_with_the_rows_that_fit(root: Path) -> None:
    """A crop of 45° is higher than the photo, which is 26° high."""
    with pytest.raises(SettingError) as caught:
        photos(root, PerspectiveRepresentation(level=6)).setup()
    rows, columns = 17, 32
    assert "found 45° × 45° for an image that spans 48.7° × 25.47°" in str(caught.value)
    assert f"representation.dim=[{rows},{columns}]" in str(caught.value)
    photos(root, PerspectiveRepresentation(level=6, dim=[rows, columns])).setup()
    with pytest.raises(SettingError):
        photos(root, PerspectiveRepresentation(level=6, dim=[rows + 1, columns])).setup()


def test_crops_lower_than_wide_cover_the_photo_once(shared: Path) -> None:
    data = photos(shared)
    sample: Any = data.dataset("train")[0]
    assert sample.images[0].shape == (1, 16, 32, 3)
    assert sample.labels.shape == (1, 16, 32)
    evaluated: Any = data.dataset("test")[0]
    assert evaluated.target.shape == (len(evaluated.images[0]), 16, 32)
    labels = data.dataset("test").read(0).labels
    share = (evaluated.target > 0).sum() / (labels > 0).sum()
    crop_pixel = (2 * np.tan(np.deg2rad(22.5)) * streets.CAMERA["fx"] / 16 / 32) ** 2
    assert share * crop_pixel == pytest.approx(1, abs=0.05)
