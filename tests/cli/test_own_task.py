"""A head of somebody else's package from the command line, without a change to this one."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import pytest
import torch

from tests.cli.tiny_runs import SMALL_ROOMS, Run
from tests.decoded import decoded
from tests.running import ROOT

PACKAGE = ROOT / "tests" / "heads" / "toy_share"
TRUST = "trust=[toy_share.ShareHead]"
SETTINGS = (
    f"--config-dir={PACKAGE / 'configs'}",
    "task=share",
    "logger=csv",
    *SMALL_ROOMS,
    "representation.base_level=0",
    "network.widths=[4,8]",
    "optimizer.lr=0.1",
    "trainer.max_epochs=3",
    "panels=1",
    "hydra.run.dir=own",
)


def _logged(folder: Path) -> list[float]:
    """The validation's mean absolute error after each epoch."""
    (path,) = folder.rglob("metrics.csv")
    with path.open(newline="") as file:
        return [float(row["val/mae"]) for row in csv.DictReader(file) if row["val/mae"]]


def test_a_head_of_ones_own_trains_evaluates_reports_and_resumes(
    rooms: str, run: Run, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.syspath_prepend(PACKAGE.parent)
    run("train", *SETTINGS, rooms)
    folder = Path("own")
    scores = _logged(folder)
    assert min(scores) < max(scores)
    assert len(scores) == 3
    best = torch.load(folder / "checkpoints" / "best.ckpt", weights_only=True)
    assert scores[best["epoch"]] == min(scores), "the smallest error is the best"
    assert json.loads((folder / "validation.json").read_text())["best"] == min(scores)
    results = json.loads((folder / "results.json").read_text())
    assert 0 < results["scores"]["mae"] < 1
    assert (results["noun"], results["images"], results["classes"]) == ("panoramas", 2, [])
    text = f"mean absolute error {results['scores']['mae']:.3g} over 2 panoramas"
    assert text in (folder / "results.md").read_text()
    assert text in (folder / "report.html").read_text()
    (panel,) = (folder / "panels").iterdir()
    assert (decoded(panel.read_bytes()) == (255, 0, 0)).all(-1).any(), "its own picture"

    typed = (SETTINGS[0], "data=synthrooms", "task=share", *SMALL_ROOMS, rooms)
    run("evaluate", *typed, f"checkpoint={folder}/checkpoints/best.ckpt", "hydra.run.dir=again")
    again = json.loads(Path("again/results.json").read_text())
    assert again["scores"]["mae"] == results["scores"]["mae"]
    capsys.readouterr()
    run("report", "own")
    assert "mean absolute error" in capsys.readouterr().out
    with Path("report/report.csv").open(newline="") as file:
        lines = [(row["fold"], row["score"], float(row["mean"])) for row in csv.DictReader(file)]
    assert lines == [(fold, "mae", results["scores"]["mae"]) for fold in ("1", "mean")]
    assert Path("report/report.png").stat().st_size > 5000

    run("train", f"resume={folder}", "trainer.max_epochs=4", TRUST)
    assert torch.load(folder / "checkpoints" / "last.ckpt", weights_only=True)["epoch"] == 3
    assert json.loads((folder / "validation.json").read_text())["best"] <= min(scores)
