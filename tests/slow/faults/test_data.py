"""Broken files of data sets in their real formats: the check finds them, training refuses them.

They are named before training, or left out and counted if that is asked for.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from lightning.pytorch.trainer.states import TrainerFn

from datamodules.core.data_module import DataModule
from datamodules.core.splits import SPLITS
from datamodules.folder.labeled import FolderPanoramas
from datamodules.modelnet40.shapes import ModelNet40
from datamodules.stanford2d3ds.panoramas import Stanford2D3DS
from tangent_train.errors import DataError
from tangent_train.rendering import EquirectRepresentation
from tests.cli.tiny_runs import run_command
from tests.conftest import fabricate
from tests.datamodules.data_files import names_of
from tests.datamodules.folder.folder_format import write_data_set
from tests.datamodules.shapes_format import write_tree

_ERP = EquirectRepresentation(level=3)
_BOTH: Any = ("rgb", "depth")

_KINDS = ("folder", "stanford", "shapes")


def _write(kind: str, root: Path) -> Path:
    """Write a data set of one of `_KINDS`; returns its root."""
    if kind == "folder":
        return write_data_set(root, depth=True)
    return write_tree(root) if kind == "shapes" else fabricate(root)


def _module(kind: str, root: Path, **settings: Any) -> DataModule:
    """Its data module, with depth."""
    if kind == "shapes":
        return ModelNet40(root, _ERP, **settings)
    of_images = FolderPanoramas if kind == "folder" else Stanford2D3DS
    return of_images(root, _ERP, inputs=_BOTH, **settings)


def _colors(kind: str, root: Path) -> list[Path]:
    """Color images or meshes, in order."""
    pattern = {
        "folder": "images/**/*.*",
        "stanford": "area_*/pano/rgb/*.png",
        "shapes": "**/*.off",
    }
    return sorted(root.glob(pattern[kind]))


def _partner(kind: str, path: Path, part: str) -> Path:
    """The labels or the depth of an image.

    Args:
        kind: One of `_KINDS`.
        path: From `_colors`.
        part: ``labels`` or ``depth``.
    """
    if kind == "folder":
        return path.parents[2] / part / path.parent.name / f"{path.stem}.png"
    domain = "semantic" if part == "labels" else part
    return path.parents[1] / domain / path.name.replace("domain_rgb", f"domain_{domain}")


def _truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-20])


def _corrupt(path: Path) -> None:
    """Change bytes in the middle: the header, the chunks and the size stay as they are."""
    content = bytearray(path.read_bytes())
    middle = content.index(b"IDAT") + 12
    content[middle : middle + 8] = bytes(255 - byte for byte in content[middle : middle + 8])
    path.write_bytes(content)


def _change(path: Path, edit: Callable[[Any], Any]) -> None:
    """Write an image with other pixels."""
    image = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_UNCHANGED)
    path.write_bytes(cv2.imencode(".png", edit(image))[1].tobytes())


def _smaller(path: Path) -> None:
    _change(path, lambda image: image[::2, ::2])


def _narrower(path: Path) -> None:
    _change(path, lambda image: np.ascontiguousarray(image[:, :-4]))


def _to_8_bits(path: Path) -> None:
    _change(path, lambda image: (image >> 8).astype(np.uint8))


def _link_to_itself(path: Path) -> None:
    path.unlink()
    path.symlink_to(path.name)


@pytest.fixture
def root(kind: str, tmp_path: Path) -> Path:
    """A whole data set of a kind, in a folder with a trying name."""
    return _write(kind, tmp_path / "Küche 1 [b] 部屋 ∕ a,b=c")


@pytest.mark.parametrize("kind", _KINDS)
def test_a_good_data_set_has_no_problem_whatever_its_folder_is_called(
    kind: str, root: Path
) -> None:
    before = {path: path.stat().st_mtime_ns for path in root.rglob("*")}
    problems, count = _module(kind, root).check()
    assert not problems.listed()
    assert count == len(_colors(kind, root)) > 0
    after = {path: path.stat().st_mtime_ns for path in root.rglob("*")}
    assert after == before, "nothing is written"


# --- one fault at a time ------------------------------------------------------------------------


_FAULTS = [
    ("stanford", "rgb", _truncate, "truncated; expected a whole PNG"),
    ("stanford", "labels", _corrupt, "no image that can be decoded"),
    ("stanford", "depth", _to_8_bits, "8-bit [a-zA-Z]+; expected 16-bit"),
    ("stanford", "labels", _smaller, r"\(width × height\); expected .*, as "),
    ("stanford", "labels", Path.unlink, "No such file"),
    ("stanford", "rgb", _link_to_itself, "Too many levels of symbolic links"),
    ("stanford", "rgb", _narrower, "expected twice as wide"),
    ("folder", "depth", _to_8_bits, "uint8 of shape"),
    ("shapes", "rgb", _truncate, "expected"),
]
"""Kind of data set, part of the second image, what is done to it, what is to be found."""


@pytest.mark.parametrize(("kind", "part", "damage", "expected"), _FAULTS)
def test_a_damaged_file_is_found(
    kind: str, part: str, damage: Callable[[Path], None], expected: str, root: Path
) -> None:
    second = _colors(kind, root)[1]
    path = second if part == "rgb" else _partner(kind, second, part)
    damage(path)
    problems, _ = _module(kind, root).check()
    by_file = {problem.file: problem for problem in problems.listed()}
    assert str(path) in by_file, by_file
    finding = by_file[str(path)].finding
    assert str(path) not in finding, "the path is named once"
    assert re.search(expected, finding), finding
    if damage not in (_narrower, _to_8_bits):  # its partners do not fit then
        assert len(by_file) == 1


# --- left out -----------------------------------------------------------------------------------


def _damage(kind: str, root: Path, *, headers: bool = True) -> list[Path]:
    """Two broken files: the first has a broken header, the other has to be decoded."""
    paths = [path for path in _colors(kind, root) if kind != "folder" or path.suffix == ".png"]
    broken = [paths[1], paths[-1]]
    for number, path in enumerate(broken):
        if kind == "shapes" or (headers and number == 0):
            _truncate(path)
        else:
            broken[number] = _partner(kind, path, "labels")
            _corrupt(broken[number])
    return broken


@pytest.mark.parametrize("stored", [False, True])
@pytest.mark.parametrize("kind", _KINDS)
def test_broken_files_are_refused_or_left_out_and_counted(
    kind: str, stored: bool, root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    whole, settings = _module(kind, root), {"store": tmp_path / "store" if stored else None}
    before = {split: names_of(whole, split) for split in SPLITS}
    total = sum(map(len, before.values()))
    broken = _damage(kind, root, headers=not stored)
    with pytest.raises(DataError) as refused:
        _module(kind, root, **settings).prepare_data()
    named = [str(path) in str(refused.value) for path in broken]
    assert named == [True, stored or kind == "shapes"]
    assert ("found 2 problems" in str(refused.value)) == all(named)
    kept = len(list((tmp_path / "store").rglob("*.npy")))
    assert kept == (total - 2 if stored else 0), "every readable one is stored"
    capsys.readouterr()
    data = _module(kind, root, skip_broken=True, **settings)
    data.prepare_data()
    data.setup()
    printed = [line for line in capsys.readouterr().out.splitlines() if "left out" in line]
    assert printed == [
        f"2 of {total} {data.noun} are broken and left out (data.skip_broken=true); "
        "tangent-check lists them."
    ]
    left = 0
    for split in SPLITS:
        after = names_of(data, split)
        left += len(after)
        assert [name for name in before[split] if name in after] == after
        for index in range(len(after)):
            read = data.dataset(split).read(index)
            assert kind == "shapes" or read.rgb.shape == (16, 32, 3)
    assert left == total - 2


# --- as training begins -------------------------------------------------------------------------


def _as_in_training(data: DataModule) -> DataModule:
    """Return a data module in the state in which `Trainer.fit` prepares its data."""
    trainer: Any = SimpleNamespace(state=SimpleNamespace(fn=TrainerFn.FITTING))
    data.trainer = trainer
    return data


# --- the command --------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["stanford"])
def test_the_command_lists_problems_line_by_line(
    kind: str, root: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(root.parent)
    arguments = ("data=stanford2d3ds", "level=3", f"data.root='{root}'")
    run_command(monkeypatch, "check", *arguments)
    assert "Nothing is wrong; 14 panoramas" in capsys.readouterr().out
    cut, corrupted = _damage(kind, root)
    with pytest.raises(SystemExit) as left:
        run_command(monkeypatch, "check", *arguments, "data.skip_broken=true")
    assert left.value.code == 1
    captured = capsys.readouterr()
    lines = [line.split("\t") for line in captured.out.splitlines()]
    assert [line[0] for line in lines] == sorted([str(cut), str(corrupted)])
    assert lines[0][1:] == [
        f"{cut.stat().st_size} bytes, truncated; expected a whole PNG",
        "Copy or extract the file again.",
    ]
    assert "2 problems; 14 panoramas" in captured.err
