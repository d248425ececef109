"""Broken files are named before training, or left out and counted if that is asked for."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from lightning.pytorch.trainer.states import TrainerFn

from datamodules.core import found as found_module
from datamodules.core.found import Found, Split
from datamodules.core.panoramas import ImageFiles
from datamodules.core.problems import Problems
from datamodules.core.split_module import SplitDataModule
from tangent_train.errors import DataError
from tests.cli.tiny_runs import run_command
from tests.conftest import FabricateStanford
from tests.slow.faults import data_sets as sets
from tests.slow.faults.data_sets import colors, module, names, partner, write


def _as_in_training(data: SplitDataModule[Any]) -> SplitDataModule[Any]:
    """As Lightning leaves it when `Trainer.fit` asks it to prepare its data."""
    trainer: Any = SimpleNamespace(state=SimpleNamespace(fn=TrainerFn.FITTING))
    data.trainer = trainer
    return data


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


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return tmp_path / sets.NAME


# --- left out -----------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", sets.KINDS)
def test_broken_files_are_refused_or_left_out_and_counted(
    kind: str, root: Path, fabricate_stanford: FabricateStanford, capsys: pytest.CaptureFixture[str]
) -> None:
    write(kind, root, fabricate_stanford)
    before = names(module(kind, root))
    total = sum(map(len, before.values()))
    first, _ = _damage(kind, root)
    with pytest.raises(DataError) as refused:
        module(kind, root).prepare_data()
    assert str(first) in str(refused.value)
    capsys.readouterr()
    data = module(kind, root, skip_broken=True)
    data.prepare_data()
    data.setup()
    after = names(data)
    printed = [line for line in capsys.readouterr().out.splitlines() if "left out" in line]
    assert printed == [
        f"2 of {total} {data.noun} are broken and left out (data.skip_broken=true); "
        "tangent-check lists them."
    ]
    assert sum(map(len, after.values())) == total - 2
    for split in before:
        assert [name for name in before[split] if name in after[split]] == after[split]
        source: Any = data.source(split)  # type: ignore[arg-type]
        for index, name in enumerate(after[split]):
            assert source.name(index) == name
            source.read(index)


# --- with a store and in memory -----------------------------------------------------------------


@pytest.mark.parametrize("kind", ["folder", "stanford"])
def test_a_store_has_no_holes_unless_they_are_asked_for(
    kind: str, root: Path, fabricate_stanford: FabricateStanford, tmp_path: Path
) -> None:
    write(kind, root, fabricate_stanford)
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
    assert sum(map(len, names(data).values())) == total - 2
    for split in ("train", "val", "test"):
        source = data.source(split)
        for index in range(len(source)):
            assert source.read(index).rgb.shape == (16, 32, 3)


# --- as training begins -------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["folder", "stanford"])
def test_training_begins_with_a_look_at_some_images_of_all_splits(
    kind: str,
    root: Path,
    fabricate_stanford: FabricateStanford,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(found_module, "SAMPLED", 100)
    write(kind, root, fabricate_stanford)
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


def test_the_look_is_short_and_goes_everywhere(monkeypatch: pytest.MonkeyPatch) -> None:
    lengths: dict[Split, int] = {"train": 1000, "val": 100, "test": 400}
    items = {
        split: [ImageFiles(f"{split} {k}", Path(), Path()) for k in range(count)]
        for split, count in lengths.items()
    }

    def _seen(seed: int) -> list[str]:
        seen: list[str] = []
        found = Found("images", items, lambda files: seen.append(files.name))
        found.read_some(seed, Problems())
        return seen

    first = _seen(seed=0)
    assert len(first) == len(set(first)) == found_module.SAMPLED
    counts = [sum(name.startswith(split) for name in first) for split in lengths]
    assert np.abs(np.array(counts) - np.array([1000, 100, 400]) * 32 / 1500).max() <= 1
    assert set(_seen(seed=1)) != set(first), "other runs look at others"
    assert set(_seen(seed=0)) == set(first)
    monkeypatch.setattr(found_module, "_SECONDS", -1)
    assert 0 < len(_seen(seed=0)) < found_module.SAMPLED, "images may be large, and disks slow"


# --- the commands -------------------------------------------------------------------------------


def test_the_command_lists_problems_line_by_line(
    tmp_path: Path,
    fabricate_stanford: FabricateStanford,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    root = write("stanford", tmp_path / sets.NAME, fabricate_stanford)
    arguments = ("data=stanford2d3ds", "level=3", f"data.root='{root}'")
    run_command(monkeypatch, "check", *arguments)
    assert "Nothing is wrong; 14 panoramas" in capsys.readouterr().out
    cut, corrupted = _damage("stanford", root)
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
