"""The benchmarks run at toy size."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks.__main__ import MEASURED, ON_A_GPU, main


@pytest.mark.parametrize("name", MEASURED)
def test_every_benchmark_runs(name: str, tmp_path: Path) -> None:
    main([name, "--quick", "--output", str(tmp_path)])
    path = tmp_path / "results.json"
    content = json.loads(path.read_text(encoding="utf-8"))
    for table in content["tables"]:
        assert table["name"].startswith(f"{name}: ")
        assert any(row["is_ours"] for row in table["rows"])
        assert all(min(row["values"]) > 0 for row in table["rows"])
    assert content["quotients"]
    for command in ("compare", "baseline"):
        with pytest.raises(SystemExit, match="found a run with --quick"):
            main([command, str(path)])


@pytest.mark.parametrize("name", ON_A_GPU)
def test_every_benchmark_of_gpus_runs(name: str, tmp_path: Path) -> None:
    # A process of its own: torch.compile does not go with the shape checks of the tests.
    command = [sys.executable, "-m", "benchmarks", "gpu", name, "--output", str(tmp_path)]
    subprocess.run(command, check=True, cwd=Path(__file__).parents[2])
    content = json.loads((tmp_path / "results.json").read_text(encoding="utf-8"))
    assert content["failures"] == []
    for table in content["tables"]:
        assert all(min(row["values"]) > 0 for row in table["rows"])
