"""Broken files of data sets in their real formats: the check finds them, training refuses them.

They are named before training, or left out and counted if that is asked for.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from lightning.pytorch.trainer.states import TrainerFn

from datamodules.core import found as found_module
from datamodules.core.found import SPLITS
from datamodules.core.split_module import SplitDataModule
from tangent_train.errors import DataError
from tests.cli.tiny_runs import run_command
from tests.datamodules.data_files import names_of
from tests.slow.faults import data_sets as sets
from tests.slow.faults.data_sets import colors, module, partner


@pytest.fixture
def root(kind: str, tmp_path: Path) -> Path:
    """A whole data set of a kind, in a folder with a trying name."""
    return sets.write(kind, tmp_path / "Küche 1 [b] 部屋 ∕ a,b=c")


@pytest.mark.parametrize("kind", sets.KINDS)
def test_a_good_data_set_has_no_problem_whatever_its_folder_is_called(
    kind: str, root: Path
) -> None:
    before = {path: path.stat().st_mtime_ns for path in root.rglob("*")}
    problems, count = module(kind, root).check()
    assert not problems.listed()
    assert count == len(colors(kind, root)) > 0
    after = {path: path.stat().st_mtime_ns for path in root.rglob("*")}
    assert after == before, "nothing is written"


# --- one fault at a time ------------------------------------------------------------------------


_FAULTS = [
    ("stanford", "rgb", sets.truncate, "truncated; expected a whole PNG"),
    ("stanford", "labels", sets.corrupt, "no image that can be decoded"),
    ("stanford", "depth", sets.to_8_bits, "8-bit [a-zA-Z]+; expected 16-bit"),
    ("stanford", "labels", sets.smaller, "pixels; expected .*, as "),
    ("stanford", "labels", Path.unlink, "No such file"),
    ("stanford", "labels", sets.past_the_table, r"instance 521 in 1 pixel; expected 0 to 520"),
    ("stanford", "rgb", sets.link_to_itself, "Too many levels of symbolic links"),
    ("stanford", "rgb", sets.narrower, "expected twice as wide"),
    ("folder", "labels", sets.corrupt, "no image that can be decoded"),
    ("folder", "depth", sets.to_8_bits, "uint8 of shape"),
    ("shapes", "rgb", sets.truncate, "expected"),
]
"""Kind of data set, part of the second image, what is done to it, what is to be found."""


@pytest.mark.parametrize(("kind", "part", "damage", "expected"), _FAULTS)
def test_a_damaged_file_is_found(
    kind: str, part: str, damage: Callable[[Path], None], expected: str, root: Path
) -> None:
    second = colors(kind, root)[1]
    path = second if part == "rgb" else partner(kind, second, part)
    damage(path)
    problems, _ = module(kind, root).check()
    by_file = {problem.file: problem for problem in problems.listed()}
    assert str(path) in by_file, by_file
    finding = by_file[str(path)].finding
    assert str(path) not in finding, "said once"
    assert re.search(expected, finding), finding
    if damage not in (sets.narrower, sets.to_8_bits):  # its partners do not fit then
        assert len(by_file) == 1


# --- left out -----------------------------------------------------------------------------------


def _damage(kind: str, root: Path) -> tuple[Path, Path]:
    """An image whose header tells that it is broken, and one that has to be read for that."""
    paths = [path for path in colors(kind, root) if kind != "folder" or path.suffix == ".png"]
    sets.truncate(paths[0])
    if kind == "shapes":
        sets.truncate(paths[-1])
        return paths[0], paths[-1]
    labels = partner(kind, paths[-1], "labels")
    sets.corrupt(labels)
    return paths[0], labels


@pytest.mark.parametrize("kind", sets.KINDS)
def test_broken_files_are_refused_or_left_out_and_counted(
    kind: str, root: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    whole = module(kind, root)
    before = {split: names_of(whole, split) for split in SPLITS}
    total = sum(map(len, before.values()))
    first, _ = _damage(kind, root)
    with pytest.raises(DataError) as refused:
        module(kind, root).prepare_data()
    assert str(first) in str(refused.value)
    capsys.readouterr()
    data = module(kind, root, skip_broken=True)
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
            data.source(split).read(index)
    assert left == total - 2


@pytest.mark.parametrize("kind", ["folder"])
def test_a_store_has_no_holes_unless_they_are_asked_for(
    kind: str, root: Path, tmp_path: Path
) -> None:
    total = len(colors(kind, root))
    broken = [partner(kind, path, "labels") for path in (colors(kind, root)[i] for i in (5, -1))]
    for path in broken:
        sets.corrupt(path)
    store = tmp_path / "store"
    data = module(kind, root, store=store)
    with pytest.raises(DataError, match="found 2 problems") as caught:
        data.prepare_data()
    data.setup()
    assert all(str(path) in str(caught.value) for path in broken), "not only the first"
    assert len(list(store.rglob("*.npy"))) == total - 2, "every readable image is stored"
    data = module(kind, root, store=store, skip_broken=True)
    data.prepare_data()
    data.setup()
    sources = [data.source(split) for split in SPLITS]
    assert sum(map(len, sources)) == total - 2
    for source in sources:
        for index in range(len(source)):
            assert source.read(index).rgb.shape == (16, 32, 3)


# --- as training begins -------------------------------------------------------------------------


def _as_in_training(data: SplitDataModule[Any]) -> SplitDataModule[Any]:
    """As Lightning leaves it when `Trainer.fit` asks it to prepare its data."""
    trainer: Any = SimpleNamespace(state=SimpleNamespace(fn=TrainerFn.FITTING))
    data.trainer = trainer
    return data


@pytest.mark.parametrize("kind", ["stanford"])
def test_training_begins_with_a_look_at_some_images_of_all_splits(
    kind: str, root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(found_module, "SAMPLED", 100)
    _as_in_training(module(kind, root)).prepare_data()
    broken = [partner(kind, path, "labels") for path in colors(kind, root)[1::3]]
    for path in broken:
        sets.corrupt(path)
    assert len(broken) > 2
    with pytest.raises(DataError, match=f"found {len(broken)} problems") as caught:
        _as_in_training(module(kind, root)).prepare_data()
    text = str(caught.value)
    assert all(str(path) in text for path in broken), "all of these are looked at"
    assert "tangent-check" in text
    assert "data.skip_broken=true" in text


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
    assert "2 problems; 13 panoramas" in captured.err
