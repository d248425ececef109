"""Broken files of a data set in its real format: the check finds them, training refuses them."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from datamodules.core.files import SPLITS
from datamodules.stanford2d3ds.panoramas import Stanford2D3DS
from tangent_train.errors import DataError
from tangent_train.rendering import EquirectRepresentation
from tests.conftest import fabricate
from tests.datamodules.data_files import names_of, read_png, write_png


def _truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def _corrupt(path: Path) -> None:
    """Change bytes in the middle: the header, the chunks and the size stay as they are."""
    content = bytearray(path.read_bytes())
    middle = content.index(b"IDAT") + 12
    content[middle : middle + 8] = bytes(255 - byte for byte in content[middle : middle + 8])
    path.write_bytes(content)


def _halve(path: Path) -> None:
    write_png(path, np.ascontiguousarray(read_png(path)[::2, ::2]))


@pytest.mark.parametrize(
    ("part", "damage", "expected"),
    [
        ("rgb", _truncate, "(?i)truncated"),
        ("semantic", _corrupt, "no image that can be decoded"),
        ("semantic", _halve, r"\(width × height\); expected .*, as "),
    ],
)
def test_a_damaged_file_is_found_and_left_out_if_asked(
    part: str, damage: Callable[[Path], None], expected: str, tmp_path: Path
) -> None:
    root = fabricate(tmp_path / "Küche 1 [b] 部屋 ∕ a,b=c")

    def data(**settings: Any) -> Stanford2D3DS:
        erp = EquirectRepresentation(level=3)
        return Stanford2D3DS(root, erp, inputs=["rgb", "depth"], **settings)

    assert not data().check()[0].listed()
    path = sorted(root.glob(f"area_*/pano/{part}/*.png"))[1]
    damage(path)
    (problem,) = data().check()[0].listed()
    assert problem.file == str(path)
    assert re.search(expected, problem.finding), problem.finding
    with pytest.raises(DataError, match=re.escape(str(path))):
        data(cache=tmp_path / "cache").prepare_data()
    left = data(skip_broken=True)
    left.prepare_data()
    assert sum(len(names_of(left, split)) for split in SPLITS) == 13
