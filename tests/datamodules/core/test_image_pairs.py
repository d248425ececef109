"""Pairs of one's own panoramas."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from datamodules.core.panorama_pairs import ImagePairs
from tangent_train.errors import DataError, SettingError
from tests.datamodules.data_files import write_png


def _write(path: Path, grey: int, shape: tuple[int, int] = (8, 16)) -> Path:
    write_png(path, np.full((*shape, 3), (grey, 0, 255), np.uint8))
    return path


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for k, name in enumerate(("a.png", "b.png", "c/d.png", "e.png")):
        _write(tmp_path / "in" / name, 10 * k)
    return tmp_path / "in"


def test_the_pairs_of_a_folder(folder: Path) -> None:
    assert ImagePairs(input=str(folder)).names == ["a – b", "b – c/d", "c/d – e"]
    every = ImagePairs(input=str(folder / "*.png"), pairing="all")
    assert every.names == ["a – b", "a – e", "b – e"]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({}, "input: found left=None"),
        ({"input": ".", "pairing": "every"}, "pairing: found every"),
        ({"left": ".", "right": "a.png"}, ".: found 5; expected two panoramas"),
        ({"input": "a.png"}, "a.png: found 1; expected two panoramas or more"),
    ],
)
def test_settings_that_do_not_fit_are_named(
    folder: Path, monkeypatch: pytest.MonkeyPatch, settings: dict[str, Any], message: str
) -> None:
    monkeypatch.chdir(folder)
    with pytest.raises((SettingError, DataError), match=re.escape(message)):
        ImagePairs(**settings)


def test_photos_are_refused_when_read_and_a_column_too_many_is_not(tmp_path: Path) -> None:
    _write(tmp_path / "a.png", 0, (8, 17))
    _write(tmp_path / "b.png", 0, (8, 12))
    with pytest.raises(DataError, match=r"b\.png: found 8×12 pixels"):
        ImagePairs(input=str(tmp_path)).read(0)
    path = str(tmp_path / "a.png")
    assert ImagePairs(path, path).read(0).left.rgb.shape == (8, 16, 3)
