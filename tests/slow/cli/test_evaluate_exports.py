"""`tangent-evaluate` of exported networks repeats the figures of their run."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.cli.tiny_runs import SMALL_ROOMS, Run, results

DATA = [text for text in SMALL_ROOMS if text.startswith(("data.", "trainer."))]


@pytest.mark.parametrize("suffix", ["safetensors", "onnx"])
def test_an_export_has_the_figures_of_its_run(
    suffix: str, rooms: str, run_folder: Path, tmp_path: Path, run: Run
) -> None:
    checkpoint = f"checkpoint={run_folder / 'checkpoints' / 'best.ckpt'}"
    run("export", checkpoint, f"output=network.{suffix}")
    arguments = [f"checkpoint=network.{suffix}", "data=synthrooms", rooms, *DATA]
    run("evaluate", *arguments, "hydra.run.dir=exported")
    found, expected = results(tmp_path / "exported"), results(run_folder)
    assert found["images"] == expected["images"]
    differing = np.abs(np.subtract(found["confusion"], expected["confusion"])).sum()
    # onnxruntime rounds otherwise: a few pixels between two classes may change sides.
    assert differing <= (0 if suffix == "safetensors" else 0.01 * np.sum(expected["confusion"]))
    assert f"network.{suffix}" in (tmp_path / "exported" / "report.html").read_text()
