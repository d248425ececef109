"""Every study runs from the command line and leaves its table and picture."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from studies.distorted_digits import distorted_digits, small_digits
from tests.running import run_python


@pytest.mark.parametrize(
    "name", ["fov", "surface_area", "angular_resolution", "representation_distortion"]
)
def test_a_study_leaves_its_files(name: str, tmp_path: Path) -> None:
    done = run_python(tmp_path, "-m", f"studies.{name}")
    assert done.stdout.startswith("| "), done.stderr
    written = sorted((tmp_path / "figures").iterdir())
    assert [path.name for path in written] == [f"{name}.csv", f"{name}.png"]
    assert len(written[0].read_text(encoding="utf-8").splitlines()) > 4


def test_distortion_costs_accuracy() -> None:
    with torch.random.fork_rng(devices=[]):
        rows = distorted_digits(small_digits(), epochs=3, seeds=(0, 1))
    assert rows[0]["distorted"] == rows[0]["enlarged"] > 60
    assert rows[-1]["distorted"] < rows[0]["distorted"] - 1
