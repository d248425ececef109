"""Faults of files, each injected into a data set in its real format: the check finds them."""

from __future__ import annotations

import errno
import io
import os
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.conftest import FabricateStanford
from tests.slow.faults import data_sets as sets
from tests.slow.faults.data_sets import colors, module, partner, write


def _found(kind: str, root: Path, **settings: Any) -> dict[str, str]:
    """Finding by file, relative to the root."""
    problems, _ = module(kind, root, **settings).check()
    return {
        os.path.relpath(problem.file, root): f"{problem.finding} | {problem.remedy}"
        for problem in problems.listed()
    }


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
_BROKEN = "a broken image; expected one that decodes"
_NO_IMAGE = "no image that can be decoded"
_LOOP = "Too many levels of symbolic links"
_FAULTS = [
    ("stanford", "rgb", sets.truncate, _TRUNCATED),
    ("stanford", "labels", sets.corrupt, _BROKEN),
    ("stanford", "depth", sets.to_8_bits, "8-bit [a-zA-Z]+; expected 16-bit"),
    ("stanford", "labels", sets.smaller, "pixels; expected .*, as "),
    ("stanford", "labels", Path.unlink, "No such file"),
    ("stanford", "labels", _past_the_table, r"instance 521 in 1 pixel; expected 0 to 520"),
    ("stanford", "rgb", sets.link_to_itself, _LOOP),
    ("stanford", "rgb", _other_shape, "expected twice as wide"),
    ("stanford photos", "pose", Path.unlink, "No such file"),
    ("synthia photos", "labels", sets.corrupt, _BROKEN),
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


# --- folders, names, copies ---------------------------------------------------------------------


def test_an_empty_folder_a_missing_area_and_a_damaged_file_at_once(
    root: Path, fabricate_stanford: FabricateStanford
) -> None:
    write("stanford", root, fabricate_stanford)
    for path in (root / "area_3" / "pano" / "rgb").iterdir():
        path.unlink()
    shutil.rmtree(root / "area_6")
    first = colors("stanford", root)[0]
    sets.truncate(first)
    sets.corrupt(partner("stanford", first, "labels"))
    sets.corrupt(colors("stanford", root)[-1])
    found = _found("stanford", root)
    assert {name: text.partition(";")[0] for name, text in found.items()} == {
        ".": "no area_6",
        "area_3/pano/rgb": "no panoramas",
        str(first.relative_to(root)): f"{first.stat().st_size} bytes, truncated",
        str(colors("stanford", root)[-1].relative_to(root)): "a broken image",
    }


# --- what may not be opened, and links ----------------------------------------------------------


@pytest.mark.parametrize("kind", ["folder", "shapes"])
def test_files_that_may_not_be_read(
    kind: str, root: Path, fabricate_stanford: FabricateStanford, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Root may read all files, so the refusal is simulated."""
    write(kind, root, fabricate_stanford)
    closed = colors(kind, root)[1]
    opened = io.open

    def refuse(file: Any, *arguments: Any, **settings: Any) -> Any:
        if os.fspath(file) == str(closed):
            raise PermissionError(errno.EACCES, "Permission denied", str(closed))
        return opened(file, *arguments, **settings)

    monkeypatch.setattr(io, "open", refuse)
    monkeypatch.setattr("builtins.open", refuse)
    monkeypatch.setattr(os, "cpu_count", lambda: 1)  # no other processes, which could open it
    found = _found(kind, root)
    assert list(found) == [str(closed.relative_to(root))]
    assert "Permission denied" in "".join(found.values())
