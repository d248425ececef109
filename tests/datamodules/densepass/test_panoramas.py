"""DensePASS: decoding, both spellings, the area, empty splits."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from lightning.pytorch.trainer.states import TrainerFn

from datamodules import DensePASS
from datamodules.core.splits import SPLITS
from tangent_train.errors import DataError
from tangent_train.rendering import EquirectRepresentation
from tests.datamodules.cityscapes import street_format as streets
from tests.datamodules.data_files import names_of, read_png, write_png


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Not to be changed."""
    return streets.write_densepass(tmp_path_factory.mktemp("densepass"))


def panoramas(root: Path, level: int = 9, **settings: Any) -> DensePASS:
    return DensePASS(root, EquirectRepresentation(level), **settings)


def test_pixels_stay_native_in_their_rows_of_the_sphere(shared: Path) -> None:
    """1024 rows span 180°: 400 rows of 360°/2048 are rows 312 to 711."""
    source = panoramas(shared).dataset("test")
    panorama = source.read(0)
    ids = read_png(shared / "gtFine/val/cs/1_labelTrainIds.png")
    assert set(np.unique(ids)) == set(streets.TRAIN_IDS)
    expected = np.zeros((1024, 2048), int)
    expected[312:712] = np.where(ids == 255, 0, ids.astype(int) + 1)
    np.testing.assert_array_equal(panorama.labels, expected)
    np.testing.assert_array_equal(source.labels(0), expected[312:712])
    rgb = read_png(shared / "leftImg8bit/val/cs/1_.png")[..., ::-1]
    np.testing.assert_array_equal(panorama.rgb[312:712], rgb)


def test_both_spellings_are_read_and_all_are_for_the_test(shared: Path, tmp_path: Path) -> None:
    plain = streets.write_densepass(tmp_path, spelling="")
    for root in (shared, plain):
        data = panoramas(root)
        assert [names_of(data, split) for split in SPLITS] == [[], [], ["1", "10", "500"]]
        assert not data.val_dataloader()
        problems, count = data.check()
        assert (count, problems.listed()) == (3, [])
        assert problems.warnings == ["found 3 test; published are 100 test"]
        assert data.facts["images"] == "3 of 100"


def test_the_horizon_row_is_at_latitude_0(shared: Path) -> None:
    data = panoramas(shared, horizon_row=150)
    assert data.area == (-180, 180, -250 * 360 / 2048, 150 * 360 / 2048)
    rows = np.flatnonzero(data.dataset("test").read(0).labels.any(axis=1))
    assert (rows[0], rows[-1]) == (512 - 150, 512 + 249)
    assert panoramas(shared).area[3] == pytest.approx(35.15, abs=0.01)


def test_missing_labels_other_sizes_and_an_empty_folder_are_refused(tmp_path: Path) -> None:
    root = streets.write_densepass(tmp_path)
    (root / "gtFine/val/cs/10_labelTrainIds.png").unlink()
    write_png(root / "gtFine/val/cs/11_labelTrainIds.png", np.zeros((400, 2048), np.uint8))
    write_png(root / "leftImg8bit/val/cs/500_.png", np.zeros((692, 2048, 3), np.uint8))
    problems, _ = panoramas(root).check()
    assert {Path(problem.file).name for problem in problems.listed()} == {
        *("10_labelTrainIds.png", "500_.png", "500_labelTrainIds.png"),
    }
    assert "1 without an image" in problems.warnings[-1]
    with pytest.raises(DataError, match=r"val/cs: found no panoramas.*DensePASS"):
        panoramas(root / "gtFine").setup()
    write_png(root / "leftImg8bit/val/cs/1.png", np.zeros((400, 2048, 3), np.uint8))
    with pytest.raises(DataError, match=r"val/cs: found panoramas in both spellings"):
        panoramas(root).setup()


def test_training_is_refused(shared: Path) -> None:
    data: Any = panoramas(shared)
    data.trainer = SimpleNamespace(state=SimpleNamespace(fn=TrainerFn.FITTING), world_size=1)
    with pytest.raises(DataError, match=r"found no panoramas for training.*Train on other"):
        data.prepare_data()
