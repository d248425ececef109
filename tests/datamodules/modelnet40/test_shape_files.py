from __future__ import annotations

from pathlib import Path
from typing import Literal

import pytest

from datamodules.modelnet40.shape_files import find_shapes
from tangent_train.errors import DataError
from tests.datamodules.modelnet40.shapes_format import COUNTS, write_tree

PARTS = ("train", "test")


def _touch(path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("")


@pytest.mark.parametrize("layout", ["by class", "by split"])
def test_both_layouts(tmp_path: Path, layout: Literal["by class", "by split"]) -> None:
    root = write_tree(tmp_path, layout)
    _touch(root / "README.txt")
    _touch(root / "spheres_64x128/chair/train/chair_0001.npy")
    _touch(root / "modelnet40_train/._chair_0001.off" if layout == "by split" else root / ".x.off")
    _touch(root / ("modelnet40_test/list.txt" if layout == "by split" else "chair/train/a.txt"))
    found = find_shapes(root)
    counted = {
        label: tuple(sum(s.label == label and s.part == p for s in found) for p in PARTS)
        for label in COUNTS
    }
    assert counted == COUNTS
    assert len(found) == sum(map(sum, COUNTS.values()))
    assert len({shape.name for shape in found}) == len(found)
    for shape in found:
        assert shape.path == root / f"{shape.name}.off"
    assert found == sorted(found, key=lambda shape: (shape.part, shape.name))


def test_a_class_that_is_only_tested(tmp_path: Path) -> None:
    write_tree(tmp_path, counts={"cup": (1, 1), "chair": (0, 1)})
    with pytest.raises(DataError, match="only test shapes of chair"):
        find_shapes(tmp_path)
