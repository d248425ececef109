"""Faults of files, each injected into a data set in its real format: the check finds them."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from tests.conftest import FabricateStanford
from tests.slow.faults import data_sets as sets
from tests.slow.faults.data_sets import colors, module, partner, write


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return tmp_path / sets.NAME


@pytest.mark.parametrize("kind", sets.KINDS)
def test_a_good_data_set_has_no_problem_whatever_its_folder_is_called(
    kind: str, root: Path, fabricate_stanford: FabricateStanford
) -> None:
    write(kind, root, fabricate_stanford)
    before = {path: path.stat().st_mtime_ns for path in root.rglob("*")}
    problems, count = module(kind, root).check()
    assert not problems.listed()
    assert count == len(colors(kind, root)) > 0
    after = {path: path.stat().st_mtime_ns for path in root.rglob("*")}
    assert after == before, "nothing is written"


# --- one fault at a time ------------------------------------------------------------------------


def _other_shape(path: Path) -> None:
    sets.change(path, lambda image: np.ascontiguousarray(image[:, :-4]))


def _past_the_table(path: Path) -> None:
    sets.set_pixel(path, [521 & 255, 521 >> 8, 0])


_TRUNCATED = "truncated; expected a whole PNG"
_NO_IMAGE = "no image that can be decoded"
_LOOP = "Too many levels of symbolic links"
_FAULTS = [
    ("stanford", "rgb", sets.truncate, _TRUNCATED),
    ("stanford", "labels", sets.corrupt, _NO_IMAGE),
    ("stanford", "depth", sets.to_8_bits, "8-bit [a-zA-Z]+; expected 16-bit"),
    ("stanford", "labels", sets.smaller, "pixels; expected .*, as "),
    ("stanford", "labels", Path.unlink, "No such file"),
    ("stanford", "labels", _past_the_table, r"instance 521 in 1 pixel; expected 0 to 520"),
    ("stanford", "rgb", sets.link_to_itself, _LOOP),
    ("stanford", "rgb", _other_shape, "expected twice as wide"),
    ("folder", "labels", sets.corrupt, _NO_IMAGE),
    ("folder", "depth", sets.to_8_bits, "uint8 of shape"),
    ("folder", "labels", sets.smaller, "16×32 pixels; expected 32"),
    ("shapes", "rgb", sets.truncate, "expected"),
]
"""Kind of data set, part of the second image, what is done to it, what is to be found."""


@pytest.mark.parametrize(("kind", "part", "damage", "expected"), _FAULTS)
def test_a_damaged_file_is_found(
    kind: str,
    part: str,
    damage: Callable[[Path], None],
    expected: str,
    root: Path,
    fabricate_stanford: FabricateStanford,
) -> None:
    write(kind, root, fabricate_stanford)
    second = colors(kind, root)[1]
    path = second if part == "rgb" else partner(kind, second, part)
    damage(path)
    problems, _ = module(kind, root).check()
    by_file = {problem.file: problem for problem in problems.listed()}
    assert str(path) in by_file, by_file
    finding = by_file[str(path)].finding
    assert str(path) not in finding, "said once"
    assert re.search(expected, finding), finding
    if damage not in (_other_shape, sets.to_8_bits):  # its partners do not fit then
        assert len(by_file) == 1
