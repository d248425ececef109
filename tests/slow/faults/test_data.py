"""Faults of files, each injected into a data set in its real format: the check finds them."""

from __future__ import annotations

import errno
import io
import os
import re
import shutil
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pytest
from PIL import Image

from datamodules import SynthRooms
from tangent_train.errors import DataError
from tests.datamodules.folder.folder_format import write_classes
from tests.slow.faults import data_sets as sets
from tests.slow.faults.data_sets import colors, module, partner, write

if TYPE_CHECKING:
    from collections.abc import Callable

    from tests.conftest import FabricateStanford


def _found(kind: str, root: Path, **settings: Any) -> dict[str, str]:
    """Finding by file, relative to the root."""
    problems, _ = module(kind, root, **settings).check(progress=False)
    return {
        os.path.relpath(problem.file, root): f"{problem.finding} | {problem.remedy}"
        for problem in problems.listed()
    }


def _told(kind: str, root: Path) -> dict[str, str]:
    """Finding by file, also of what is refused before anything is listed."""
    try:
        problems, _ = module(kind, root).check(progress=False)
    except DataError as error:
        return {str(error.subject): str(error.found)}
    return {problem.file: problem.finding for problem in problems.listed()}


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return tmp_path / sets.NAME


@pytest.mark.parametrize("kind", sets.KINDS)
def test_a_good_data_set_has_no_problem_whatever_its_folder_is_called(
    kind: str, root: Path, fabricate_stanford: FabricateStanford
) -> None:
    write(kind, root, fabricate_stanford)
    before = {path: path.stat().st_mtime_ns for path in root.rglob("*")}
    problems, count = module(kind, root).check(progress=False)
    assert not problems.listed()
    assert count == len(colors(kind, root)) > 0
    after = {path: path.stat().st_mtime_ns for path in root.rglob("*")}
    assert after == before, "nothing is written"


# --- one fault at a time ------------------------------------------------------------------------


class _Fault(NamedTuple):
    """What is done to a file of the second image, and what is to be found."""

    kind: str
    name: str
    part: str
    damage: Callable[[Path], None]
    finding: str


def _small_panorama(path: Path) -> None:
    sets.change(path, lambda image: np.ascontiguousarray(image[:8, :16]))


_REMOVE = Path.unlink
_TRUNCATED = "truncated; expected a whole PNG"
_BROKEN = "a broken image; expected one that decodes"
_LOOP = "Too many levels of symbolic links"
_FAULTS = [
    *(
        _Fault(kind, name, part, damage, finding)
        for kind in ("stanford", "synthia photos")
        for name, part, damage, finding in (
            ("truncated", "rgb", sets.truncate, _TRUNCATED),
            ("truncated depth", "depth", sets.truncate, _TRUNCATED),
            ("corrupted", "rgb", sets.corrupt, _BROKEN),
            ("corrupted labels", "labels", sets.corrupt, _BROKEN),
            ("corrupted depth", "depth", sets.corrupt, _BROKEN),
            ("bit depth of depth", "depth", sets.to_8_bits, "8-bit [a-zA-Z]+; expected 16-bit"),
            ("labels of another size", "labels", sets.smaller, "pixels; expected .*, as "),
            ("no labels", "labels", _REMOVE, "No such file"),
            ("symlink loop", "rgb", sets.link_to_itself, _LOOP),
        )
    ),
    *(
        _Fault(
            kind, "wrong shape", "rgb", partial(sets.change, edit=edit), "expected twice as wide"
        )
        for kind in ("stanford", "omnisynthia")
        for edit in [lambda image: np.ascontiguousarray(image[:, :-4])]
    ),
    *(
        _Fault(
            kind,
            "too few rows",
            "rgb",
            _small_panorama,
            r"erp_height: found 16; expected .* 8 rows",
        )
        for kind in ("stanford", "omnisynthia")
    ),
    *(
        _Fault(
            kind,
            "label past the table",
            "labels",
            partial(sets.set_pixel, value=[521 & 255, 521 >> 8, 0]),
            r"instance 521 in 1 pixel; expected 0 to 520, the entries of the class table",
        )
        for kind in ("stanford", "stanford photos")
    ),
    _Fault(
        "omnisynthia",
        "label past the table",
        "labels",
        partial(sets.set_pixel, value=16),
        "labels 16; expected 0 to 15",
    ),
    _Fault(
        "synthia photos",
        "label past the table",
        "labels",
        partial(sets.set_pixel, value=[0, 0, 16]),
        "labels 16; expected 0 to 15",
    ),
    _Fault(
        "stanford photos",
        "missing pose key",
        "pose",
        partial(sets.without_key, key="camera_k_matrix"),
        "KeyError: 'camera_k_matrix'; expected a pose file",
    ),
    _Fault("stanford photos", "no pose", "pose", _REMOVE, "No such file"),
    _Fault("folder", "truncated", "rgb", sets.truncate, "no image that can be decoded"),
    _Fault("folder", "truncated labels", "labels", sets.truncate, _TRUNCATED),
    _Fault("folder", "corrupted labels", "labels", sets.corrupt, "no image that can be decoded"),
    _Fault("folder", "corrupted depth", "depth", sets.corrupt, "no image that can be decoded"),
    _Fault("folder", "bit depth of depth", "depth", sets.to_8_bits, "uint8 of shape"),
    _Fault("folder", "labels of another size", "labels", sets.smaller, "16×32 pixels; expected 32"),
    _Fault("folder", "symlink loop", "rgb", sets.link_to_itself, _LOOP),
    _Fault("shapes", "truncated", "rgb", sets.truncate, "expected"),
    _Fault("shapes", "symlink loop", "rgb", sets.link_to_itself, _LOOP),
]


def _file(kind: str, root: Path, part: str) -> Path:
    if part == "png":  # the others are of all formats
        return next(path for path in colors(kind, root) if path.suffix == ".png")
    second = colors(kind, root)[1]
    return second if part == "rgb" else partner(kind, second, part)


@pytest.mark.parametrize("fault", _FAULTS, ids=lambda fault: f"{fault.kind}: {fault.name}")
def test_a_damaged_file_is_found(
    fault: _Fault, root: Path, fabricate_stanford: FabricateStanford
) -> None:
    write(fault.kind, root, fabricate_stanford)
    path = _file(fault.kind, root, fault.part)
    fault.damage(path)
    problems, _ = module(fault.kind, root).check(progress=False)
    # Of a picture whose colours have another size, all its partners are said.
    by_file = {problem.file: problem for problem in problems.listed()}
    assert str(path) in by_file, by_file
    finding = by_file[str(path)].finding
    assert str(path) not in finding, "said once"
    assert re.search(fault.finding, finding), finding
    assert fault.name in ("wrong shape", "too few rows", "bit depth") or len(by_file) == 1


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


def test_wrong_lines_of_a_list(root: Path, fabricate_stanford: FabricateStanford) -> None:
    write("folder", root, fabricate_stanford)
    lines = ["scene_0/view.0", "scene_0/view.7", "scene_0/view.0", "scene_1/view.0"]
    (root / "test.txt").write_text("\n".join(lines))
    problems, _ = module("folder", root).check(progress=False)
    findings = [problem.finding for problem in problems.listed()]
    assert [text.partition(";")[0] for text in findings] == [
        f"'scene_0/view.0', also in {root / 'test.txt'}",
        "'scene_0/view.7', of which there is no image",
    ]


def test_values_past_the_list_of_classes(root: Path, fabricate_stanford: FabricateStanford) -> None:
    """In a list every value has a place; values or colours by name leave others unknown."""
    write("folder", root, fabricate_stanford)
    assert not _found("folder", root), "4 and 0 have no name"
    write_classes(root, [None, "wall", "floor", "floor 2"])
    labels = sorted((root / "labels").rglob("*.png"))
    expected = {
        str(path.relative_to(root)) for path in labels if (np.asarray(Image.open(path)) == 4).any()
    }
    found = _found("folder", root)
    assert set(found) == expected, "255 is unknown"
    assert all("value 4 in " in text and "write null" in text for text in found.values())
    assert len(expected) > 1


def test_rooms_that_are_not_made(tmp_path: Path) -> None:
    data = SynthRooms(tmp_path / "rooms", sets.ERP, rooms={"rooms": {"area_1": 2, "area_5a": 1}})
    (problem,) = data.check(progress=False)[0].listed()
    assert problem.finding == "no such folder; expected the data set"
    assert "tangent-prepare" in problem.remedy
    assert not data.root.exists()


# --- what may not be opened, and links ----------------------------------------------------------


@pytest.mark.parametrize("kind", sets.KINDS)
def test_files_that_may_not_be_read(
    kind: str, root: Path, fabricate_stanford: FabricateStanford, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As every account but that of root meets them; root may read all, so the refusal is made."""
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


def test_links(root: Path, fabricate_stanford: FabricateStanford) -> None:
    write("folder", root, fabricate_stanford)
    images = root / "images"
    elsewhere = root.parent / "elsewhere"
    elsewhere.mkdir()
    (images / "scene_0").rename(elsewhere / "scene_0")
    (images / "scene_0").symlink_to(elsewhere / "scene_0")
    (images / "round").symlink_to(images)
    assert not _found("folder", root), "links to folders elsewhere are as good as folders"
    (images / "scene_1" / "lost.jpg").symlink_to(elsewhere / "lost.jpg")
    (images / "scene_1" / ".hidden").symlink_to("nowhere")
    found = _found("folder", root)
    assert "No such file" in found["images/scene_1/lost.jpg"]
