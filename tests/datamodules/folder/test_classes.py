"""``classes.json``: values or colors of classes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from datamodules.core.label_map import LabelMap, read_label_map
from tangent_train.errors import DataError


def _read(folder: Path, content: Any) -> LabelMap:
    path = folder / "classes.json"
    path.write_text(json.dumps(content))
    return read_label_map(path)


def test_a_list_names_the_values_from_0(tmp_path: Path) -> None:
    found = _read(tmp_path, ["wall", None, "floor"])
    assert found.names == ("wall", "floor")
    values = np.array([[0, 1, 2, 255]], np.uint8)
    assert found.decode(values).tolist() == [[1, 0, 2, 0]]
    assert found.decode(np.array([65535], np.uint16)).tolist() == [0]
    with pytest.raises(DataError, match=r"labels: found 3, 9 in 2 pixels; expected 0, 1, 2"):
        found.decode(np.array([3, 9, 0], np.uint8))


def test_an_object_names_values_and_others_are_unknown(tmp_path: Path) -> None:
    found = _read(tmp_path, {"wall": 1, "floor": [2, 3], "window": 255, "sky": 40000})
    values = np.array([0, 1, 2, 3, 255, 40000, 7], np.uint16)
    assert found.decode(values).tolist() == [0, 1, 2, 2, 3, 4, 0]


def test_an_object_names_colors(tmp_path: Path) -> None:
    found = _read(tmp_path, {"wall": "#ff0000", "floor": ["#00FF00", "#00ee01"]})
    colors = np.array([[[255, 0, 0], [0, 255, 0], [0, 238, 1], [0, 0, 0], [1, 0, 0]]], np.uint8)
    assert found.decode(colors).tolist() == [[1, 2, 2, 0, 0]]


def test_names_of_classes_are_mapped_to_other_classes(tmp_path: Path) -> None:
    found = _read(tmp_path, {"source": "x", "classes": {"seat": ["Chair", "arm-chair"], "bed": []}})
    assert found.names == ("seat", "bed")
    assert found.labels == {"chair": 1, "arm chair": 1}


@pytest.mark.parametrize(
    "content",
    [
        "wall",
        [],
        ["a", "a"],
        [1],
        {"a": 1, "b": 1},
        {"a": 1, "b": "#00ff00"},
        [f"{k}" for k in range(255)],
    ],
)
def test_other_files_are_refused(tmp_path: Path, content: Any) -> None:
    with pytest.raises(DataError, match=r"classes\.json: found"):
        _read(tmp_path, content)
