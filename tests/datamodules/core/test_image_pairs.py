"""Pairs of one's own panoramas."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from datamodules.core.image_pairs import ImagePairs
from tangent_train.errors import DataError, SettingError


def _write(path: Path, grey: int, shape: tuple[int, int] = (8, 16)) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), np.full((*shape, 3), (grey, 0, 255), np.uint8))
    return path


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for k, name in enumerate(("a.png", "b.png", "c/d.png", "e.png")):
        _write(tmp_path / "in" / name, 10 * k)
    return tmp_path / "in"


def test_two_files(folder: Path) -> None:
    pairs = ImagePairs(left=str(folder / "b.png"), right=str(folder / "a.png"))
    assert len(pairs) == 1
    assert pairs.name(0) == "b – a"
    pair = pairs.read(0)
    assert (pair.left.name, pair.right.name, pair.split) == ("b", "a", None)
    assert pair.left.rgb[0, 0].tolist() == [255, 0, 10]
    assert pair.left.distance_m is None
    assert pair.left.pose is None
    assert pair.left.file == folder / "b.png"


def test_the_pairs_of_a_folder(folder: Path) -> None:
    following = ImagePairs(input=str(folder))
    assert [following.name(k) for k in range(len(following))] == ["a – b", "b – d", "d – e"]
    every = ImagePairs(input=str(folder / "*.png"), pairing="all")
    assert [every.name(k) for k in range(len(every))] == ["a – b", "a – e", "b – e"]


def test_namesakes_are_told_apart(tmp_path: Path) -> None:
    for name in ("one/room.png", "two/room.png", "two/room.jpg"):
        _write(tmp_path / name, 0)
    pairs = ImagePairs(input=str(tmp_path / "*" / "room.png"))
    assert pairs.name(0) == "one/room – two/room"
    kinds = ImagePairs(input=str(tmp_path / "two"))
    assert kinds.name(0) == "room.jpg – room.png"
    twice = ImagePairs(left=str(tmp_path / "one/room.png"), right=str(tmp_path / "one/room.png"))
    assert twice.name(0) == "room – room"


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({}, "input: found none"),
        ({"left": "a.png"}, "input: found left=a.png"),
        ({"left": "a.png", "right": "b.png", "input": "x"}, "input: found left=a.png"),
        ({"left": "a.png", "input": "x"}, "input: found left=a.png, input=x"),
        ({"input": ".", "pairing": "every"}, "pairing: found every"),
        ({"left": ".", "right": "a.png"}, "left: found 4 images"),
        ({"left": "a.png", "right": "nofile.png"}, "right: no such file: nofile.png"),
    ],
)
def test_settings_that_do_not_fit_are_named(
    folder: Path, monkeypatch: pytest.MonkeyPatch, settings: dict[str, Any], message: str
) -> None:
    monkeypatch.chdir(folder)
    with pytest.raises(SettingError, match=re.escape(message)):
        ImagePairs(**settings)


def test_one_panorama_is_no_pair(tmp_path: Path) -> None:
    _write(tmp_path / "a.png", 0)
    with pytest.raises(DataError, match="two panoramas or more"):
        ImagePairs(input=str(tmp_path))


def test_photos_are_refused_when_read_and_a_column_too_many_is_not(tmp_path: Path) -> None:
    _write(tmp_path / "a.png", 0, (8, 17))
    _write(tmp_path / "b.png", 0, (8, 12))
    pairs = ImagePairs(input=str(tmp_path))
    with pytest.raises(
        DataError, match=r"b\.png: found 8×12 pixels; .* GPano tags that say where it lies\.$"
    ):
        pairs.read(0)
    assert ImagePairs(str(tmp_path / "a.png"), str(tmp_path / "a.png")).read(0).left.rgb.shape == (
        8,
        16,
        3,
    )
