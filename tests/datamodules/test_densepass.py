"""DensePASS: decoding, both spellings, the area, empty splits."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from datamodules.core.files import SPLITS
from datamodules.densepass import DensePASS
from tangent_train.rendering import EquirectRepresentation
from tests.datamodules import street_format as streets
from tests.datamodules.data_files import names_of, read_png


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Not to be changed."""
    return streets.write_densepass(tmp_path_factory.mktemp("densepass"))


def panoramas(root: Path, level: int = 9, **settings: Any) -> DensePASS:
    return DensePASS(root, EquirectRepresentation(level), **settings)


def test_pixels_stay_native_in_their_rows_of_the_sphere(shared: Path) -> None:
    """1024 rows span 180°: 400 rows of 360°/2048 are rows 312 to 711."""
    panorama = panoramas(shared).dataset("test").read(0)
    ids = read_png(shared / "gtFine/val/cs/1_labelTrainIds.png")
    assert set(np.unique(ids)) == set(streets.TRAIN_IDS)
    expected = np.zeros((1024, 2048), int)
    expected[312:712] = np.where(ids == 255, 0, ids.astype(int) + 1)
    np.testing.assert_array_equal(panorama.labels, expected)
    rgb = read_png(shared / "leftImg8bit/val/cs/1_.png")[..., ::-1]
    np.testing.assert_array_equal(panorama.rgb[312:712], rgb)


def test_both_spellings_are_read_and_all_are_for_the_test(shared: Path, tmp_path: Path) -> None:
    plain = streets.write_densepass(tmp_path, spelling="")
    for root in (shared, plain):
        data = panoramas(root)
        assert [names_of(data, split) for split in SPLITS] == [[], [], ["1", "10", "500"]]
        problems, count = data.check()
        assert (count, problems.listed()) == (3, [])
        assert problems.warnings == ["found 3 test; published are 100 test"]


def test_the_horizon_row_is_at_latitude_0(shared: Path) -> None:
    data = panoramas(shared, horizon_row=150)
    assert data.area == (-180, 180, -250 * 360 / 2048, 150 * 360 / 2048)
    rows = np.flatnonzero(data.dataset("test").read(0).labels.any(axis=1))
    assert (rows[0], rows[-1]) == (512 - 150, 512 + 249)
