"""``tangent-keypoints``: pairs in, tables and pictures out; interrupted, resumed, refused."""

from __future__ import annotations

import csv
import json
import os
import re
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from omegaconf import OmegaConf

from datamodules.core.image_pairs import ImagePairs
from datamodules.stanford2d3ds.pairs import StanfordPairs, published_pairs
from tangent_train.cli import main
from tangent_train.cli.compose import check_overrides, config_folder
from tangent_train.cli.keypoint_pairs.arguments import keypoint_arguments
from tangent_train.cli.keypoint_pairs.settings import EXPORTS, KeypointSettings
from tangent_train.cli.keypoints import keypoints
from tangent_train.errors import SettingError
from tangent_train.keypoints import motion_search
from tangent_train.results.keypoints.compare import Comparer, Comparison
from tests.results.keypoints.ball_room import ball_pair

pytest.importorskip("pycolmap")

Run = Callable[..., None]
SMALL = ["base_level=0", "controls=false", "pictures=0"]


@pytest.fixture(scope="module")
def panoramas(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three panoramas from inside a textured ball, two of them alike."""
    folder = tmp_path_factory.mktemp("panoramas")
    pair = ball_pair(shape=(96, 192))
    for name, side in (("a", pair.left), ("b", pair.right), ("c", pair.left)):
        assert cv2.imwrite(str(folder / f"{name}.png"), side.rgb)
    return folder


@pytest.fixture
def run(tmp_path: Path, panoramas: Path, monkeypatch: pytest.MonkeyPatch) -> Run:
    """Runs the command as it is typed, in a folder of its own."""
    monkeypatch.chdir(tmp_path)

    def typed(*arguments: str) -> None:
        words = [argument.replace("$PANORAMAS", str(panoramas)) for argument in arguments]
        monkeypatch.setattr(sys, "argv", ["tangent-keypoints", *words])
        main.keypoints()

    return typed


def _results(folder: Path) -> dict[str, Any]:
    content: dict[str, Any] = json.loads((folder / "results.json").read_text())
    return content


def _rows(folder: Path) -> list[dict[str, str]]:
    return list(csv.DictReader((folder / "pairs.csv").read_text().splitlines()))


def _names(folder: Path) -> list[str]:
    return [pair["name"] for pair in _results(folder)["pairs"]]


# What comes out.


def test_two_panoramas(run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run("left=$PANORAMAS/a.png", "right=$PANORAMAS/b.png", "base_level=0,1", "output=out (1)")
    output = tmp_path / "out (1)"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out (1)"]
    assert sorted(path.name for path in output.iterdir()) == [
        "keypoints.md",
        "matches",
        "pairs.csv",
        "results.json",
    ]
    content = _results(output)
    assert content["settings"]["base_level"] == [0, 1]
    (entry,) = content["pairs"]
    assert entry["name"] == "a – b"
    rows = _rows(output)
    names = ["ERP", "ERP_shrunk", "L0", "L1"]
    assert [row["representation"] for row in rows] == names * 2
    assert [row["condition"] for row in rows] == ["as_given"] * 4 + ["turned"] * 4
    assert {row["visible_by"] for row in rows} == {"all keypoints"}
    for row, scored in zip(rows, entry["scored"], strict=True):
        assert float(row["pmr"]) == scored["pmr"]
        assert int(row["putative"]) == scored["putative"] > 10
    pictures = sorted((output / "matches").iterdir())
    assert [path.name for path in pictures] == ["000_a_b_as_given.png", "000_a_b_turned.png"]
    picture = cv2.imread(str(pictures[0]))
    assert picture is not None
    assert picture.shape[1] == 2 * 724
    shown = capsys.readouterr().out
    assert "1 pair, sift, ERP, ERP ×0.71, L0, L1" in shown
    assert "Results are in out (1)." in shown
    assert "n_L and n_R are all keypoints" in (output / "keypoints.md").read_text()


def test_the_same_panorama_twice_matches_itself(run: Run, tmp_path: Path) -> None:
    run("left=$PANORAMAS/a.png", "right=$PANORAMAS/c.png", *SMALL, "output=out")
    (entry,) = _results(tmp_path / "out")["pairs"]
    for scored in entry["scored"]:
        assert scored["kind"] == "rotation"
        assert scored["pmr"] > 0.95
        assert scored["p"] == 1
    assert not (tmp_path / "out" / "matches").exists()


def test_made_rooms_have_depth_and_splits(run: Run, tmp_path: Path) -> None:
    rooms = ["data.rooms.rooms.area_1=2", "data.rooms.height=64", "data.rooms.supersample=1"]
    run("output=out", "data.root=rooms", *rooms, *SMALL)
    entries = _results(tmp_path / "out")["pairs"]
    assert len(entries) >= 2
    for entry in entries:
        assert entry["has_geometry"]
        assert 0 < entry["fov_overlap"] <= 1
        for scored in entry["scored"]:
            assert scored["visible_left"] <= scored["keypoints_left"]
    text = (tmp_path / "out" / "keypoints.md").read_text()
    assert "| hard |" in text
    assert "| easy |" in text
    assert "by depth and pose" in text
    assert "paper" not in text


def test_the_papers_pairs_stand_beside_the_papers_figures(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pair = ball_pair(shape=(48, 96))
    monkeypatch.setattr(StanfordPairs, "__len__", lambda _self: 60)
    monkeypatch.setattr(StanfordPairs, "name", lambda _self, index: str(index))
    monkeypatch.setattr(
        StanfordPairs,
        "read",
        lambda _self, k: pair._replace(name=str(k), split=published_pairs()[k].split),
    )
    run("data=stanford2d3ds_pairs", "data.root=.", "max_pairs=2", *SMALL, "output=out")
    assert _names(tmp_path / "out") == ["0", "1"]
    text = (tmp_path / "out" / "keypoints.md").read_text()
    assert "| paper | 30 | 83.35 | 298 |" in text
    assert "|  | PMR %, paper | 22.2 | 28.4 |" in text
    assert "| paper |  | 83 | 25 / 12 / 51 | 28 / 14 / 50 |" in text


@pytest.mark.parametrize("kind", ["colmap_text", "colmap_database"])
def test_export_for_colmap(
    run: Run, tmp_path: Path, panoramas: Path, capsys: pytest.CaptureFixture[str], kind: str
) -> None:
    import pycolmap

    arguments = ("input=$PANORAMAS", *SMALL, "output=out", f"export={kind}")
    run(*arguments)
    export = tmp_path / "out" / "export"
    assert sorted(path.name for path in export.iterdir()) == ["ERP", "L0", "export.json"]
    index = json.loads((export / "export.json").read_text())
    assert index == {"kind": kind, "image_path": str(panoramas), "pairs": ["a – b", "b – c"]}
    entries = _results(tmp_path / "out")["pairs"]
    for k, name in enumerate(("ERP", "L0")):
        counts = [entry["scored"][k] for entry in entries]
        if kind == "colmap_text":
            header = (export / name / "a.png.txt").read_text().partition("\n")[0]
            assert header == f"{counts[0]['keypoints_left']} 128"
            lists = (export / name / "matches.txt").read_text().strip().split("\n\n")
            assert [text.partition("\n")[0] for text in lists] == ["a.png b.png", "b.png c.png"]
            assert [text.count("\n") for text in lists] == [s["putative"] for s in counts]
            continue
        database = pycolmap.Database.open(export / name / "database.db")
        assert [image.name for image in database.read_all_images()] == ["a.png", "b.png", "c.png"]
        assert database.num_matches() == sum(s["putative"] for s in counts)
        assert database.num_inlier_matches() == sum(s["inliers"] for s in counts)
        database.close()
    capsys.readouterr()
    run(*arguments)
    shown = capsys.readouterr().out
    assert "2 of them are there already" in shown
    assert "Comparing pairs" not in shown  # no bar of nothing
    # Asked for afterwards, all pairs are compared once more; their figures are the same.
    (export / "export.json").unlink()
    run(*arguments)
    again = _results(tmp_path / "out")["pairs"]
    assert [e["scored"] for e in again] == [e["scored"] for e in entries]
    assert (export / "export.json").is_file()


def test_names_that_colmaps_text_cannot_hold_are_refused_before_any_work(
    run: Run, tmp_path: Path, panoramas: Path
) -> None:
    folder = tmp_path / "my photos"  # COLMAP's names are relative to it
    folder.mkdir()
    for old, new in (("a", "a"), ("b", "b"), ("c", "living room")):
        (folder / f"{new}.png").write_bytes((panoramas / f"{old}.png").read_bytes())
    arguments = ("input=my photos", *SMALL, "export=colmap_text", "output=out")
    message = r"export: found colmap_text of 'living room\.png'; .* export=colmap_database"
    with pytest.raises(SystemExit, match=message):
        run(*arguments)
    assert not (tmp_path / "out").exists()
    run(*arguments, "max_pairs=1")
    assert (tmp_path / "out/export/L0/matches.txt").is_file()


# Interrupted, gone on with, thrown away.


@pytest.mark.parametrize(("signal_", "status"), [(signal.SIGTERM, 143), (signal.SIGINT, 130)])
def test_a_signal_ends_a_run_that_can_be_gone_on_with(
    run: Run,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
    signal_: signal.Signals,
    status: int,
) -> None:
    true_compare = Comparer.compare

    def signalled(self: Comparer, pair: Any) -> Comparison:
        if pair.name == "b – c":
            os.kill(os.getpid(), signal_)
        return true_compare(self, pair)

    monkeypatch.setattr(Comparer, "compare", signalled)
    before = signal.getsignal(signal.SIGTERM)
    # What shells start in the background ignores Ctrl-C; Python then leaves it so.
    by_shell = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(SystemExit) as stopped:
            run("input=$PANORAMAS", *SMALL, "output=out")
    finally:
        signal.signal(signal.SIGINT, by_shell)
    assert stopped.value.code == status
    shown = capfd.readouterr()
    assert "Interrupted: 1 of 2 pairs are done. The same command goes on." in shown.out
    assert "SIGTERM" not in shown.err
    assert _names(tmp_path / "out") == ["a – b"]
    assert signal.getsignal(signal.SIGTERM) == before


def test_an_interrupted_run_goes_on(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ("input=$PANORAMAS", "pairing=all", *SMALL, "output=out")
    true_compare = Comparer.compare
    compared: list[str] = []

    def interrupted(self: Comparer, pair: Any) -> Comparison:
        compared.append(pair.name)
        if len(compared) == 2:
            raise KeyboardInterrupt
        return true_compare(self, pair)

    with monkeypatch.context() as patch:
        patch.setattr(Comparer, "compare", interrupted)
        with pytest.raises(SystemExit) as stopped:
            run(*arguments)
        assert stopped.value.code == 130
        assert "Interrupted: 1 of 3 pairs are done" in capsys.readouterr().out
        assert _names(tmp_path / "out") == ["a – b"]
        first = _results(tmp_path / "out")["pairs"][0]
        run(*arguments)
    assert compared == ["a – b", "a – c", "a – c", "b – c"]
    assert "1 of them are there already" in capsys.readouterr().out
    assert _names(tmp_path / "out") == ["a – b", "a – c", "b – c"]
    assert _results(tmp_path / "out")["pairs"][0] == first
    assert len(_rows(tmp_path / "out")) == 3 * 2


def test_missing_pictures_are_drawn_and_fewer_pairs_take_nothing_away(
    run: Run, tmp_path: Path
) -> None:
    run("input=$PANORAMAS", *SMALL, "output=out")
    run("input=$PANORAMAS", *SMALL[:2], "pictures=1", "max_pairs=1", "output=out")
    assert [path.name for path in (tmp_path / "out/matches").iterdir()] == ["000_a_b_as_given.png"]
    assert _names(tmp_path / "out") == ["a – b", "b – c"]


def test_other_settings_need_another_folder(run: Run, tmp_path: Path) -> None:
    arguments = ("left=$PANORAMAS/a.png", "right=$PANORAMAS/b.png", *SMALL, "output=out")
    run(*arguments)
    (tmp_path / "out" / "mine.txt").write_text("mine")
    with pytest.raises(SystemExit, match=r"ratio: found 0\.7; expected 0\.8, as for the results"):
        run(*arguments, "ratio=0.7")
    with pytest.raises(SystemExit, match=r"data: found .*; expected .*, as for the results"):
        run("left=$PANORAMAS/a.png", "right=$PANORAMAS/c.png", *SMALL, "output=out")
    run(*arguments, "ratio=0.7", "overwrite=true")
    assert _results(tmp_path / "out")["settings"]["ratio"] == 0.7
    assert (tmp_path / "out" / "mine.txt").read_text() == "mine"


@pytest.mark.parametrize("content", [None, "{", "[]", '{"program": "x"}', '{"pairs": 3}'])
def test_foreign_folders_are_left_alone(run: Run, tmp_path: Path, content: str | None) -> None:
    (tmp_path / "out").mkdir()
    name = "holiday.jpg" if content is None else "results.json"
    (tmp_path / "out" / name).write_text(content or "picture")
    for more in ((), ("overwrite=true",)):
        with pytest.raises(SystemExit, match="with other files"):
            run("input=$PANORAMAS", "output=out", *more)
    assert [path.name for path in (tmp_path / "out").iterdir()] == [name]
    (tmp_path / "file").write_text("")
    with pytest.raises(SystemExit, match="found the file file"):
        run("input=$PANORAMAS", "output=file")


# Broken pairs.


def test_a_broken_pair_is_named_and_the_others_are_compared(
    run: Run, tmp_path: Path, panoramas: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "in").mkdir()
    for name in ("a.png", "b.png"):
        (tmp_path / "in" / name).write_bytes((panoramas / name).read_bytes())
    (tmp_path / "in" / "d.png").write_bytes((panoramas / "c.png").read_bytes()[:900])
    with pytest.raises(SystemExit, match="1 of 2 pairs could not be used"):
        run("input=in", *SMALL, "output=out")
    assert "Pair b – d: in/d.png: found no image" in capsys.readouterr().out
    good, bad = _results(tmp_path / "out")["pairs"]
    assert good["error"] is None
    assert "d.png" in bad["error"]
    assert "Pairs that could not be used" in (tmp_path / "out" / "keypoints.md").read_text()
    # Mended, only that pair is compared.
    (tmp_path / "in" / "d.png").write_bytes((panoramas / "c.png").read_bytes())
    run("input=in", *SMALL, "output=out")
    assert "1 of them are there already" in capsys.readouterr().out
    assert [pair["error"] for pair in _results(tmp_path / "out")["pairs"]] == [None, None]


def test_nothing_but_broken_pairs(run: Run, tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    for name in "ab":
        assert cv2.imwrite(str(tmp_path / "in" / f"{name}.png"), np.zeros((8, 8, 3), np.uint8))
    with pytest.raises(SystemExit, match="1 of 1 pairs could not be used"):
        run("input=in", *SMALL, "output=out")
    assert not (tmp_path / "out" / "pairs.csv").exists()


def test_settings_that_suit_no_panorama_leave_no_results(
    run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    two = ("left=$PANORAMAS/a.png", "right=$PANORAMAS/b.png", *SMALL[1:], "output=out")
    for wrong, message in (
        ("base_level=5", "base_level: found 5; expected at most the level, 6, less 2"),
        ("level=7", "level: found 7; expected at most 6, that of a, 96 rows"),
    ):
        with pytest.raises(SystemExit, match=f"^tangent-keypoints: {message}"):
            run(*two, wrong)
        assert "Results are in" not in capsys.readouterr().out
    run(*two, "base_level=0")  # other settings; there are no results to be kept from it
    assert "Results are in" in capsys.readouterr().out
    assert _results(tmp_path / "out")["settings"]["base_level"] == [0]


def test_a_panorama_without_keypoints_is_named(
    run: Run, tmp_path: Path, panoramas: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cv2.imwrite(str(tmp_path / "black.png"), np.zeros((96, 192, 3), np.uint8))
    run("left=$PANORAMAS/a.png", "right=black.png", *SMALL, "output=out")
    assert "Pair a – black: no keypoint on black" in capsys.readouterr().out
    text = (tmp_path / "out" / "keypoints.md").read_text()
    assert "## Panoramas without any keypoint\n\n* black\n" in text


# Settings.


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["input=$PANORAMAS"], "output: found none"),
        (["data=synthrooms", "output=o"], "found datamodules.SynthRooms; expected pairs:"),
        (["data=synthrooms_pairs", "left=a.png", "output=o"], "left: found a.png"),
        (["left=$PANORAMAS/a.png", "output=o"], "input: found left="),
        (["data=image_pairs", "output=o"], "input: found none"),
        (["base_level=0,0", "output=o"], "base_level: found [0, 0]"),
        (["base_level=-1", "output=o"], "base_level: found -1"),
        (["base_level=2", "level=1", "output=o"], "level: found 1"),
        (["base_level=0", "level=1", "output=o"], "level: found 1; expected a whole number, 2"),
        (["detector=surf", "output=o"], "detector: found surf"),
        (["margin=-1", "output=o"], "margin: found -1"),
        (["ratio=0", "output=o"], "ratio: found 0"),
        (["ratio=1.5", "output=o"], "ratio: found 1.5; expected at most 1"),
        (["left=$PANORAMAS/a.png", "right=nofile.png", "output=o"], "right: no such file"),
        (["mutual=maybe", "output=o"], "mutual: found maybe"),
        (["max_error_deg=21", "output=o"], "max_error_deg: found 21"),
        (["max_pairs=0", "output=o"], "max_pairs: found 0"),
        (["export=bundler", "output=o"], "export: found bundler"),
        (["export=colmap_text", "detector=orb", "output=o"], "colmap_text with detector=orb"),
        (["detectors=orb", "output=o"], "Did you mean detector"),
    ],
)
def test_settings_that_cannot_work_are_named(
    run: Run, tmp_path: Path, arguments: list[str], message: str
) -> None:
    with pytest.raises(SystemExit, match=re.escape(message)):
        run(*arguments)
    assert not list(tmp_path.iterdir())


def test_pycolmap_is_missed_before_any_work(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    with pytest.raises(SettingError, match="pip install"):
        motion_search.colmap()
    with pytest.raises(SystemExit, match=re.escape("tangent-train[keypoints]")):
        run("input=$PANORAMAS", "output=out")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["synthrooms_pairs", "stanford2d3ds_pairs", "image_pairs"])
def test_pairs_are_refused_elsewhere(name: str) -> None:
    with pytest.raises(SettingError, match=f"tangent-keypoints data={name}"):
        check_overrides("train", [f"data={name}"])
    check_overrides("keypoints", [f"data={name}"])


@pytest.mark.parametrize(
    ("typed", "understood"),
    [
        (["base_level=0,1,2"], ["base_level=[0,1,2]"]),
        (["base_level=1"], ["base_level=1"]),
        (["base_level=[0,1]"], ["base_level=[0,1]"]),
        (["-m", "base_level=0,1"], ["-m", "base_level=0,1"]),
        (["input=x", "output=y"], ["data=image_pairs", "input=x", "output=y"]),
        (["--help"], ["--help"]),
        (["-c", "job", "right=x"], ["-c", "job", "data=image_pairs", "right=x"]),
        (["input=x", "data=mine"], ["input=x", "data=mine"]),
    ],
)
def test_plain_words_become_hydras(typed: list[str], understood: list[str]) -> None:
    assert keypoint_arguments(typed) == understood


def test_help_lists_the_choices(run: Run, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        run("--help")
    choices = capsys.readouterr().out.partition("== Choices ==")[2].partition("==")[0]
    pairs = [path.stem for path in (config_folder() / "data").glob("*_pairs.yaml")]
    for choice in (*pairs, "sift", "orb", "akaze", *EXPORTS, "consecutive", "all"):
        assert re.search(rf"\b{choice}\b", choices), choice
    assert "synthrooms," not in choices


def test_the_defaults_are_the_documented_ones() -> None:
    config = OmegaConf.load(config_folder() / "keypoints.yaml")
    plain: Any = OmegaConf.to_container(config)
    settings = KeypointSettings.of({**plain, "data": {}, "output": "x"})
    assert (settings.base_levels, settings.detector, settings.margin) == ((0, 1, 2), "sift", 32)
    assert (settings.ratio, settings.mutual, settings.max_error_deg) == (0.8, True, 1.0)
    assert (settings.controls, settings.export, settings.seed) == (True, "none", 0)
    assert "ratio 0.8, mutual, inliers within 1°, seed 0" in settings.told
    assert ImagePairs.__name__ in (config_folder() / "data/image_pairs.yaml").read_text()
    assert callable(keypoints)
