"""Checkpoints and class names of other people in whole runs."""

from __future__ import annotations

import csv
from pathlib import Path

import pytest

from tests.cli.tiny_runs import run_command
from tests.datamodules.folder.folder_format import write_classes, write_data_set
from tests.security.attacks import CANARY
from tests.security.honest import SECRET, SETTINGS
from tests.security.watch import watched


def test_names_of_classes_are_names(
    forbidden: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A data set's classes.json, through training, evaluation, prediction and reports."""
    monkeypatch.chdir(forbidden.parent)
    names = [
        f"${{oc.create:{{_target_: {CANARY}.fire, command: 'id > {forbidden}/x'}}}}",
        "${oc.env:SECRET}",
        "=HYPERLINK(1)",
        f"{{_target_: {CANARY}.fire}}",
    ]
    write_data_set(Path("theirs"), height=64)
    write_classes(Path("theirs"), dict(zip(names, (1, [2, 3], 255, 4), strict=True)))
    folder = ["data=folder", "data.root=theirs", "data.inputs=[rgb]", "data.num_workers=0"]
    small = [s for s in SETTINGS if not s.startswith(("experiment", "data", "representation"))]
    widths = ["network=unet_small", "representation=tangent_economy_16", *small, "level=5"]
    with watched(forbidden) as happened:
        run_command(monkeypatch, "check", *folder, "level=5")
        run_command(monkeypatch, "train", *widths, *folder, "hydra.run.dir=run")
        best = "checkpoint=run/checkpoints/last.ckpt"
        run_command(monkeypatch, "evaluate", best, "data.root=theirs", "hydra.run.dir=evaluated")
        images = next(Path("theirs/images").rglob("*.png"))
        predict = [best, f"input={images}", "output=labels", "device=cpu"]
        run_command(monkeypatch, "predict", *predict)
        run_command(monkeypatch, "report", "run", "evaluated", "--output", "report")
    assert not happened
    for file in (Path("run/results.csv"), Path("evaluated/results.csv")):
        with file.open() as opened:
            found = [row["class"] for row in csv.DictReader(opened)]
        assert found == [f"'{n}" if n.startswith("=") else n for n in names]
    written = [p for top in ("run", "evaluated", "labels", "report") for p in Path(top).rglob("*")]
    for path in written:
        assert not path.is_file() or SECRET.encode() not in path.read_bytes(), path
    assert SECRET not in capsys.readouterr().out
