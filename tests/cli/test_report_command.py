"""``tangent-report`` from the command line to the files."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from omegaconf import OmegaConf

from tangent_train.cli import main
from tangent_train.metrics.segmentation import ConfusionMatrices
from tangent_train.results.segmentation import evaluation_results, write_results

FILES = {"report.json", "report.md", "report.csv", "report.png"}


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    """Two folds as the evaluation writes them: wall 60 % and 80 % IoU, no floor in the second."""
    for fold, (hit, missed, floor) in enumerate([(60, 40, 50), (80, 20, 0)], start=1):
        erp = np.zeros((3, 3), np.int64)
        erp[1, 1], erp[1, 0], erp[2, 2] = hit, missed, floor
        matrices = ConfusionMatrices(erp, erp.astype(float), np.zeros((6, 3, 3), np.int64), 7)
        folder = tmp_path / "runs" / str(fold)
        write_results(evaluation_results(matrices, ("unknown", "wall", "floor"), "skip"), folder)
        settings = {
            "name": "mine",
            "seed": 0,
            "level": 5,
            "data": {"_target_": "datamodules.Stanford2D3DS", "fold": fold, "inputs": ["rgb"]},
        }
        OmegaConf.save(OmegaConf.create(settings), folder / "config.yaml")
    return tmp_path / "runs"


def _report(monkeypatch: pytest.MonkeyPatch, *arguments: object) -> None:
    monkeypatch.setattr(sys, "argv", ["tangent-report", *map(str, arguments)])
    main.report()


def test_the_files_hold_the_runs(
    runs: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    (runs / "cut" / "checkpoints").mkdir(parents=True)
    _report(monkeypatch, runs)
    assert {path.name for path in (tmp_path / "report").iterdir()} == FILES
    (group,) = json.loads((tmp_path / "report" / "report.json").read_text())["groups"]
    # Fold 1: (0.6 + 1) / 2, fold 2: 0.8 alone.
    assert group["means"]["miou"]["mean"] == pytest.approx(0.8)
    assert group["means"]["miou"]["over_folds"] == pytest.approx(0)
    assert group["classes"]["wall"]["iou"]["mean"] == pytest.approx(0.7)
    assert group["classes"]["floor"]["iou"]["folds"] == 1
    text = (tmp_path / "report" / "report.md").read_text()
    assert "| mine | 70.0 ± 14.1 | 100.0 of 1 |" in text
    said = capsys.readouterr().out
    for words in ("mine: fold 3 missing", "floor (1 of 2)", f"{runs / 'cut'}: not finished"):
        assert words in said
        assert words in text
    (tmp_path / "report" / "report.md").unlink()
    _report(monkeypatch, runs / "1")  # a report may be written over
    assert "mine: fold 2 and 3 missing" in (tmp_path / "report" / "report.md").read_text()


@pytest.mark.parametrize(("name", "content"), [("report.md", "# Mine"), ("report.json", "{}")])
def test_other_files_are_not_written_over(
    name: str, content: str, runs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / name).write_text(content)
    with pytest.raises(SystemExit, match=rf"--output: found .*{name}.*did not write"):
        _report(monkeypatch, runs, "--output", tmp_path / "out")
    assert [path.name for path in (tmp_path / "out").iterdir()] == [name]
    assert (tmp_path / "out" / name).read_text() == content


def test_what_cannot_be_reported_is_said_and_nothing_written(
    runs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (runs / "2" / "results.json").write_text("{")
    with pytest.raises(SystemExit, match=r"^tangent-report: .*2/results\.json: found JSONDecode"):
        _report(monkeypatch, runs)
    assert not (tmp_path / "report").exists()


def test_help_answers_before_anything_heavy_is_imported() -> None:
    code = (
        "import sys; from tangent_train.cli.main import report\n"
        "sys.argv = ['tangent-report', '--help']\n"
        "try: report()\n"
        "finally: assert not {'torch', 'matplotlib', 'omegaconf'} & set(sys.modules), 'heavy'"
    )
    done = subprocess.run([sys.executable, "-c", code], check=False, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "runs/paper/semseg_s7_b0_rgbd --output" in done.stdout
