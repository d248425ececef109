"""``tangent-keypoints``: pairs in, tables and pictures out; interrupted, resumed, refused."""

from __future__ import annotations

import csv
import re
import shutil
import sys
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from tangent_train.keypoints.compare import Comparer, Comparison
from tests.cli.tiny_runs import Run, results
from tests.keypoints.ball_room import ball_pair
from tests.running import Capture, Patch

pycolmap = pytest.importorskip("pycolmap")

SMALL = ("base_level=0", "controls=false", "pictures=0", "level=5")


@pytest.fixture(scope="module")
def panoramas(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three from inside a textured ball: one, another one, the first with a column too many."""
    folder = tmp_path_factory.mktemp("panoramas")
    left, right = (side.rgb for side in ball_pair(shape=(96, 192))[2:])
    for name, rgb in (("a", left), ("b", right), ("c", np.hstack([left, left[:, :1]]))):
        assert cv2.imwrite(str(folder / f"{name}.png"), rgb)
    return folder


@pytest.fixture
def run(run: Run) -> Run:
    """Runs ``tangent-keypoints``."""
    return partial(run, "keypoints")


def pairs_in(folder: Path) -> list[str]:
    return list(dict.fromkeys(row["pair"] for row in results(folder)["rows"]))


def test_two_panoramas_are_a_pair(
    run: Run, panoramas: Path, tmp_path: Path, capsys: Capture
) -> None:
    pair = (f"left={panoramas}/a.png", f"right={panoramas}/b.png")
    run(*pair, "base_level=[0]", "level=5", "output=out_1")
    output = tmp_path / "out_1"
    assert [path.name for path in tmp_path.iterdir()] == ["out_1"]
    names = ["finished.jsonl", "keypoints.md", "manifest.json", "matches", "pairs.csv"]
    names.append("results.json")
    assert sorted(path.name for path in output.iterdir()) == names
    rows = list(csv.DictReader((output / "pairs.csv").read_text().splitlines()))
    assert [row["representation"] for row in rows] == ["ERP", "ERP ×0.71", "cube", "L0"] * 2
    assert [row["condition"] for row in rows] == ["as_given"] * 4 + ["rotated"] * 4
    for row, kept in zip(rows, results(output)["rows"], strict=True):
        assert float(row["pmr"]) == kept["pmr"]
        assert int(row["putative"]) == kept["putative"] > 0
    pictures = sorted(path.name for path in (output / "matches").iterdir())
    assert pictures == ["000_a_b_as_given.png", "000_a_b_rotated.png"]
    assert "Results are in out_1." in capsys.readouterr().out


def test_an_interrupted_run_goes_on(
    run: Run, panoramas: Path, tmp_path: Path, monkeypatch: Patch, capsys: Capture
) -> None:
    arguments = (f"input={panoramas}", "pairing=all", *SMALL, "output=out")
    true_compare = Comparer.compare
    compared: list[str] = []

    def interrupted(self: Comparer, pair: Any) -> Comparison:
        compared.append(pair.name)
        if len(compared) == 2:
            raise KeyboardInterrupt
        return true_compare(self, pair)

    monkeypatch.setattr(Comparer, "compare", interrupted)
    with pytest.raises(SystemExit) as stopped:
        run(*arguments)
    assert stopped.value.code == 130
    run(*arguments)
    assert compared == ["a – b", "a – c", "a – c", "b – c"]
    assert "1 of 3 pairs are done already" in capsys.readouterr().out
    assert pairs_in(tmp_path / "out") == ["a – b", "a – c", "b – c"]
    run(*arguments, "max_pairs=1")  # takes nothing away
    assert len(pairs_in(tmp_path / "out")) == 3
    with pytest.raises(SystemExit, match=r"ratio: found 0\.7; expected 0\.8, with which"):
        run(*arguments, "ratio=0.7")


def test_a_broken_pair_is_named_and_the_others_are_compared(
    run: Run, tmp_path: Path, panoramas: Path, capsys: Capture
) -> None:
    (tmp_path / "in" / "c").mkdir(parents=True)
    for name in ("a.png", "b.png"):
        shutil.copy(panoramas / name, tmp_path / "in")
    whole = (panoramas / "c.png").read_bytes()
    (tmp_path / "in" / "c" / "d.png").write_bytes(whole[:900])
    with pytest.raises(SystemExit, match="1 of 2 pairs failed"):
        run("input=in", *SMALL, "output=out")
    assert "Pair b – c/d: in/c/d.png: found" in capsys.readouterr().out
    assert pairs_in(tmp_path / "out") == ["a – b"]
    # Mended, only that pair is compared.
    (tmp_path / "in" / "c" / "d.png").write_bytes(whole)
    run("input=in", *SMALL, "output=out")
    assert "1 of 2 pairs are done already" in capsys.readouterr().out
    assert pairs_in(tmp_path / "out") == ["a – b", "b – c/d"]
    # Broken pairs have no results.
    assert cv2.imwrite(str(tmp_path / "square.png"), np.zeros((8, 8, 3), np.uint8))
    with pytest.raises(SystemExit, match="1 of 1 pairs failed"):
        run("left=in/a.png", "right=square.png", *SMALL, "output=none")
    assert "square.png: found 8 × 8 (width × height)" in capsys.readouterr().out


def test_pycolmap_is_missed_before_any_work(run: Run, tmp_path: Path, monkeypatch: Patch) -> None:
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    (tmp_path / "in").mkdir()
    with pytest.raises(SystemExit, match=re.escape("pip install -e '.[keypoints]'")):
        run("input=in", "output=out")
    assert [path.name for path in tmp_path.iterdir()] == ["in"]
