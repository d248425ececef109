"""``tangent-report`` from the command line to the files."""

from __future__ import annotations

import csv
from pathlib import Path

import pytest

from tests.cli.tiny_runs import Run
from tests.results.example_results import example_result, write_run

FILES = {"report.md", "report.csv", "report.png"}


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    """Two folds, no sofa in the second."""
    write_run(
        tmp_path / "runs" / "1", example_result([0.6, 0.5, 1.0], bands=(0.6, 0.2), data__fold=1)
    )
    write_run(
        tmp_path / "runs" / "2", example_result([0.8, 0.5, None], bands=(0.6, 0.2), data__fold=2)
    )
    return tmp_path / "runs"


def test_the_files_hold_the_runs(
    runs: Path, tmp_path: Path, run: Run, capsys: pytest.CaptureFixture[str]
) -> None:
    (runs / "cut" / "checkpoints").mkdir(parents=True)
    run("report", str(runs))
    assert {path.name for path in (tmp_path / "report").iterdir()} == FILES
    with (tmp_path / "report" / "report.csv").open(newline="") as file:
        (wall,) = (
            figure
            for figure in csv.DictReader(file)
            if (figure["fold"], figure["class"], figure["score"]) == ("mean", "wall", "iou")
        )
    assert float(wall["mean"]) == pytest.approx(0.7)
    text = (tmp_path / "report" / "report.md").read_text()
    assert "| mine | 70.0 ± 14.1 | 50.0 ± 0.0 | 100.0 of 1 |" in text
    assert "| mine | 60.0 ± 0.0 | 20.0 ± 0.0 |" in text, "bands of latitude"
    assert f"| mine | 2 | 0 | {runs / '2'} |" in text
    printed = capsys.readouterr().out
    for words in ("mine: fold 3 missing", f"{runs / 'cut'}: not finished"):
        assert words in printed
        assert words in text
    (tmp_path / "report" / "report.md").unlink()
    run("report", str(runs / "1"))  # a report may be written over
    assert "mine: fold 2 and 3 missing" in (tmp_path / "report" / "report.md").read_text()
