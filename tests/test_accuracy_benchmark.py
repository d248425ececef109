from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pytest
import torch

from benchmarks import accuracy
from benchmarks.accuracy_chart import accuracy_png
from benchmarks.accuracy_folder import AccuracyFolder, Plan
from benchmarks.accuracy_rows import ORIENTATIONS, PLAIN, ROWS, Row, chosen_rows
from benchmarks.accuracy_run import composed
from benchmarks.accuracy_table import command, found_lines, goals, write_tables
from tangent_train.cli.build import build
from tangent_train.errors import SettingError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

PLAN = Plan(seconds=200, level=6, rooms_height=128, device="cpu")
ERP, FEW, TURNED = ROWS["erp"], ROWS["few"], ROWS["few_aux_so3"]
ROOT = Path(__file__).resolve().parents[1]


def _write_run(
    folder: AccuracyFolder, row: Row, seed: int, scores: Mapping[str, Sequence[float | None]]
) -> None:
    """A run whose variants have these scores, in the order of `ORIENTATIONS`."""
    evaluations = {
        variant.name: {
            "settings": list(variant.settings),
            "results": {
                orientation: {"miou": score}
                for orientation, score in zip(ORIENTATIONS, scores[variant.name], strict=True)
                if score is not None
            },
        }
        for variant in (PLAIN, *row.variants)
        if variant.name in scores
    }
    training = {"epochs": 50, "seconds": 199.0}
    folder.write_run(row, seed, {"training": training, "evaluations": evaluations})


@pytest.fixture
def folder(tmp_path: Path) -> AccuracyFolder:
    """With three rows of two seeds."""
    folder = AccuracyFolder(tmp_path / "accuracy")
    folder.begin(PLAN)
    pixels = {"panoramas": 264, "images": 1320, "pixels": 1320 * 48 * 48, "steps": 33}
    for row in (ERP, FEW, TURNED):
        folder.write_speed(row, {"epoch_seconds": 4.0, "parameters": 1_564_814, **pixels})
    for seed, more in enumerate((0.0, 0.02)):
        _write_run(folder, ERP, seed, {"plain": [0.61 + more, 0.5, 0.3, 0.2, 0.12]})
        told = [None, None, 0.9, None, 0.9]
        plain = [0.67 + more, 0.5, 0.4, 0.2, 0.11]
        found = [0.69 + more, 0.6, 0.5, None, None]
        _write_run(folder, FEW, seed, {"plain": plain, "upright=auto": found, "upright=pose": told})
        _write_run(folder, TURNED, seed, {"plain": [0.53, 0.53, 0.53, 0.52, 0.52 - more]})
    return folder


def test_lines_are_mean_and_sample_deviation_of_the_seeds(folder: AccuracyFolder) -> None:
    lines = {line.name: line for line in found_lines(folder, chosen_rows([]), seeds=2)}
    variants = ["few, upright=auto", "few, upright=pose"]
    assert list(lines) == ["erp", "few", *variants, "few_aux_so3"]
    few = lines["few"]
    assert few.scores["null"] == pytest.approx([0.67, 0.69])
    assert few.mean("null") == pytest.approx(np.mean([0.67, 0.69]))
    assert few.spread("null") == pytest.approx(np.std([0.67, 0.69], ddof=1))
    assert lines["few, upright=pose"].mean("null") is None
    (alone,) = found_lines(folder, [ERP], seeds=1)
    assert alone.mean("null") == 0.61
    assert alone.spread("null") is None


def test_goals_compare_the_best_that_are_not_told_where_up_is(folder: AccuracyFolder) -> None:
    lines = found_lines(folder, chosen_rows([]), seeds=2)
    upright, turned, kept, upright_found, *_ = goals(lines)
    assert upright == (
        "As they come: upright: few 68.0 ± 1.4, erp 62.0 ± 1.4: +6.0 mIoU (the goal is +0)."
    )
    assert "SO(3): few_aux_so3 51.0 ± 1.4, erp 12.0 ± 0.0: +39.0 mIoU" in turned
    assert "few_aux_so3 keeps 96.2 % of its upright score under SO(3) (the goal is 95 %)." in kept
    assert upright_found.startswith(
        "Up may be found in the image: upright: few, upright=auto 70.0 ± 1.4"
    )
    assert len(goals([line for line in lines if not line.variant.upright])) == 3


def test_the_table_holds_scores_rates_and_commands(folder: AccuracyFolder) -> None:
    lines = found_lines(folder, chosen_rows([]), seeds=2)
    write_tables(folder, lines)
    text = (folder.path / "accuracy.md").read_text()
    assert (
        "| few | 68.0 ± 1.4 | 50.0 ± 0.0 | 40.0 ± 0.0 | 20.0 ± 0.0 | 11.0 ± 0.0 "
        "| 2 | 66.0 | 330.0 | 0.76 | 50 | 1,564,814 |" in text
    )
    assert "| few, upright=pose | – | – | 90.0 ± 0.0 | – | 90.0 ± 0.0 | 2 |" in text
    widths = {line.count("|") for line in text.splitlines() if line.startswith(("| few", "| erp"))}
    assert widths == {4, 13}
    content = json.loads((folder.path / "accuracy.json").read_text())
    turned = content["lines"][-1]
    assert turned["miou"]["so3"]["seeds"] == [0.52, 0.5]
    assert turned["seconds"] == 200
    assert turned["command"] == (
        "tangent-train experiment=rooms/accuracy level=6 network=unet_small_aux "
        "representation.rotation=so3 trainer.max_epochs=50"
    )


def test_the_picture_grows_with_the_lines(folder: AccuracyFolder) -> None:
    lines = found_lines(folder, chosen_rows([]), seeds=2)
    pictures: list[Any] = [
        cv2.imdecode(np.frombuffer(accuracy_png(found, "title"), np.uint8), cv2.IMREAD_COLOR)
        for found in (lines[:1], lines)
    ]
    few, all_ = pictures
    assert few.shape[1] == all_.shape[1]
    assert few.shape[0] < all_.shape[0]


def test_epochs_fill_the_time_and_are_one_at_least(folder: AccuracyFolder) -> None:
    assert folder.epochs(FEW) == 50
    for seconds, epochs in ((129.0, 2), (1000.0, 1)):
        folder.write_speed(FEW, {"epoch_seconds": seconds})
        assert folder.epochs(FEW) == epochs


def test_only_what_is_lacking_is_evaluated(folder: AccuracyFolder) -> None:
    assert folder.lacking(ERP, 0) == []
    assert len(folder.lacking(ERP, 2)) == len(ORIENTATIONS)
    lacking = [(variant.name, orientation) for variant, orientation in folder.lacking(FEW, 0)]
    assert ("4 turned icosahedra", "so3") in lacking
    assert not {name for name, _ in lacking} & {"plain", "upright=pose"}
    run = folder.run(FEW, 0) or {}
    run["evaluations"]["upright=pose"]["settings"] = ["data.upright=null"]
    folder.write_run(FEW, 0, run)
    names = [variant.name for variant, _ in folder.lacking(FEW, 0)]
    assert "upright=pose" in names, "those of other settings do not count"


def test_results_of_another_plan_or_row_are_refused(folder: AccuracyFolder) -> None:
    folder.begin(PLAN)
    with pytest.raises(
        SettingError, match=r"--output: found .*seconds 200.*expected .*seconds 100"
    ):
        folder.begin(Plan(100, 6, 128, "cpu"))
    with pytest.raises(SettingError, match=r"few.*erp_crops.*The row has changed"):
        folder.run(FEW._replace(settings=("representation=erp_crops",)), 0)


def test_unknown_rows_are_refused_with_the_near_ones(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match=r"--rows: found 'few_aus'.*Did you mean few_aux"):
        accuracy.main(["--rows", "erp,few_aus", "--output", "never_made"])
    assert [row.name for row in chosen_rows(["few", "erp"])] == ["erp", "few"]
    with pytest.raises(SystemExit):
        accuracy.main(["--seeds", "0"])
    assert "1 or more" in capsys.readouterr().err


def test_other_rooms_have_a_folder_of_their_own() -> None:
    assert PLAN.overrides() == ("experiment=rooms/accuracy", "level=6")
    assert Plan(200, 7, 256, "cpu", ("data.fold=2",)).overrides() == (
        "experiment=rooms/accuracy",
        "level=7",
        "data.root=data/rooms_256",
        "data.rooms.height=256",
        "data.fold=2",
    )
    assert composed(PLAN.overrides()).data.rooms.height == PLAN.rooms_height


@pytest.mark.slow
@pytest.mark.parametrize("row", ROWS.values(), ids=ROWS)
def test_every_row_and_variant_can_be_built(row: Row) -> None:
    """Each is what it says: other images, another network or another loss than the plain one."""
    settings = (*PLAN.overrides(), *row.settings)
    with torch.device("meta"):
        _, task = build(composed(settings))
    assert hasattr(task.representation, "grid") != row.equirect
    assert (task.representation.rotation == "so3") == row.turned
    variants = [PLAIN, *row.variants]
    for variant in variants:
        config = composed((*settings, *variant.settings))
        assert (config.data.upright == "pose") == variant.told_up
        assert set(variant.orientations) <= set(ORIENTATIONS)
    assert len({variant.name for variant in variants}) == len(variants)


ROOMS = "data.rooms.rooms={area_1:3,area_2:0,area_3:0,area_4:0,area_5a:1,area_5b:0,area_6:0}"
SMALL = ["data.rooms.height=32", "representation.erp_height=32", "data.rooms.supersample=1", ROOMS]
ENVIRONMENT = {"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}


def _command(folder: Path) -> list[str]:
    """A row, one seed, one epoch, of small rooms."""
    options = [
        "--seconds",
        "0.01",
        "--seeds",
        "1",
        "--level",
        "5",
        "--rows",
        "few_cosine",
    ]
    line = [sys.executable, "-m", "benchmarks", "accuracy", *options, "--output", "made"]
    return [*line, *SMALL, f"data.root={folder / 'rooms'}"]


def _done(folder: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        _command(folder),
        check=False,
        cwd=folder,
        env=os.environ | ENVIRONMENT,
        capture_output=True,
        text=True,
        timeout=300,
    )


def _files(folder: Path) -> dict[str, int]:
    kept = [*folder.glob("made/speeds/*"), *folder.glob("made/runs/*/*/*")]
    return {path.name + path.parts[-3]: path.stat().st_mtime_ns for path in kept}


@pytest.mark.slow
def test_an_interrupted_ablation_goes_on_and_ends_with_what_the_commands_find(
    tmp_path: Path,
) -> None:
    line = _command(tmp_path)
    environment = os.environ | ENVIRONMENT
    with subprocess.Popen(
        line, cwd=tmp_path, env=environment, stdout=subprocess.PIPE, text=True
    ) as started:
        assert started.stdout is not None
        for said in started.stdout:
            if said.startswith("an epoch of few_cosine"):
                started.send_signal(signal.SIGINT)
                break
        rest = started.stdout.read()
    assert started.returncode == 130
    assert rest == "Interrupted. The same command goes on; made holds what is done.\n"
    measured = _files(tmp_path)
    assert len(measured) == 1

    done = _done(tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    assert re.search(r"\[1/1\] few_cosine, seed 0: upright \d+\.\d.*SO\(3\) \d+\.\d", done.stdout)
    files = _files(tmp_path)
    assert measured.items() <= files.items(), "what was measured is not measured again"
    assert {path.suffix for path in (tmp_path / "made").glob("accuracy.*")} == {
        ".json",
        ".md",
        ".png",
    }

    again = _done(tmp_path)
    assert again.stdout.startswith("runs: 1, done: 1\n")
    assert _files(tmp_path) == files
    _check_against_the_command(tmp_path)


def _check_against_the_command(folder: Path) -> None:
    """The command in the table, and an evaluation of its checkpoint, score the same."""
    made = AccuracyFolder(folder / "made")
    row = ROWS["few_cosine"]
    words = [*command(made, row), "trainer.accelerator=cpu", "hydra.run.dir=run"]
    _tangent(words, folder)
    run: Any = made.run(row, 0)
    scores = run["evaluations"]["plain"]["results"]
    assert scores["null"]["miou"] == _miou(folder / "run")
    checkpoint = "checkpoint=run/checkpoints/last.ckpt"
    settings = ["data.test_rotation=so3", "data.seed=0", "hydra.run.dir=turned"]
    _tangent(["tangent-evaluate", checkpoint, *settings], folder)
    assert scores["so3"]["miou"] == _miou(folder / "turned")


def _tangent(words: Sequence[str], folder: Path) -> None:
    program = Path(sys.executable).with_name(words[0])
    subprocess.run(
        [program, *words[1:]],
        check=True,
        cwd=folder,
        env=os.environ | ENVIRONMENT,
        capture_output=True,
        timeout=300,
    )


def _miou(folder: Path) -> float:
    miou: float = json.loads((folder / "results.json").read_text())["miou"]
    return miou
