from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from datamodules.core.label_map import read_label_map
from tangent_train.errors import DataError


def _write_json(path: Path, text: str) -> Path:
    (path / "classes.json").write_text(text)
    return path / "classes.json"


def test_a_list_of_classes_and_values_without_one(tmp_path: Path) -> None:
    listed = read_label_map(_write_json(tmp_path, '["wall", null, "floor"]'))
    assert listed.names == ("wall", "floor")
    assert listed.decode(np.array([0, 1, 2, 255])).tolist() == [1, 0, 2, 0]
    with pytest.raises(DataError, match="found value 3 in 1 pixel; expected 0 to 2, the places"):
        listed.decode(np.arange(4))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "Expecting value"),
        ("3", "found 3; expected a list of class names"),
        (json.dumps([str(n) for n in range(256)]), "found 256 classes"),
        ('["a", 3]', "class name 3"),
        ('["a", "b", "a"]', """class 'a' twice; expected every name once. For several values"""),
        ('{"ü": 1, "u\\u0308": 2}', "class 'ü' twice"),
        (json.dumps(["a", "\ud800"]), "without control characters"),
        (json.dumps(["a", "b\x1b[2J"]), r"class name 'b\x1b[2J'"),
        (json.dumps({"a": 1, "b\nc": 2}), r"class name 'b\nc'"),
        (json.dumps(["a", "b\x85"]), "without control characters"),
        ('["unknown", "a"]', "Leave it out; in a list, write null in its place."),
        ('{"a": 1, "b": 1}', "found 1 for 'a' and 'b'; expected every value or color once"),
        ('{"a": 1, "b": "#00ff00"}', "found values and colors; expected either"),
        ('{"a": []}', "found nothing for 'a'"),
        ('{"a": -1}', "found -1 for 'a'; expected a value of 0 to 65535"),
        ('{"a": "#fff"}', 'found "#fff" for'),
        ("[" * 100_000, "expected a list of class names"),
    ],
)
def test_class_lists_that_cannot_be_used(tmp_path: Path, text: str, message: str) -> None:
    path = _write_json(tmp_path, text)
    with pytest.raises(DataError, match=r"classes\.json: found") as info:
        read_label_map(path)
    assert message in str(info.value)
    assert len(str(info.value)) < 600
