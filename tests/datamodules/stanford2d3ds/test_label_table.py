from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from datamodules.stanford2d3ds.label_table import CLASSES, LabelTable
from tangent_train.errors import DataError


def _colors(indices: list[int]) -> np.ndarray[tuple[int, ...], np.dtype[np.uint8]]:
    return np.array([[[i >> 16, i >> 8 & 255, i & 255] for i in indices]], np.uint8)


def test_classes_are_numbered_in_alphabetical_order(tmp_path: Path) -> None:
    names = [f"{name}_1_office_1_1" for name in reversed(CLASSES)]
    path = tmp_path / "labels.json"
    path.write_text(json.dumps(["<UNK>_0_<UNK>_0_0", *names]))
    table = LabelTable.from_json(path)
    assert list(CLASSES) == sorted(CLASSES)
    assert table.class_ids.dtype == np.uint8
    assert table.class_ids.tolist() == [0, *range(13, 0, -1)]


def test_what_is_past_the_end_of_the_table_is_missing_or_a_mistake() -> None:
    # #0D0D0D without its red byte would be entry 3341 of the table.
    table = LabelTable(np.full(9816, 6, np.uint8))
    assert table.decode(_colors([0x0D0D0D, 9815])).tolist() == [[0, 6]]
    with pytest.raises(DataError, match="found instance 9816 in 2 pixels; expected 0 to 9815"):
        table.decode(_colors([0x0D0D0D, 9815, 9816, 0xFFFFFF]))
