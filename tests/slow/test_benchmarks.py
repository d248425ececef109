"""The benchmarks run at toy size, compare what is the same, and find regressions."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from benchmarks.__main__ import BASELINE, MEASURED, ON_A_GPU, Interval, main, verdicts
from benchmarks.images import check_same_views, rivals, striped_panorama
from tangent_train.geometry import TangentGrid, equirect_shape
from tangent_train.rendering import equirect_to_tangent


@pytest.mark.parametrize("name", MEASURED)
def test_every_benchmark_runs(name: str, tmp_path: Path) -> None:
    main([name, "--quick", "--output", str(tmp_path)])
    path = tmp_path / "results.json"
    for table in json.loads(path.read_text(encoding="utf-8"))["tables"]:
        assert table["name"].startswith(f"{name}: ")
        assert any(row["ours"] for row in table["rows"])
        assert all(min(row["values"]) > 0 for row in table["rows"])
    for command in ("compare", "baseline"):
        with pytest.raises(SystemExit, match="found a run with --quick"):
            main([command, str(path)])


@pytest.mark.parametrize("name", ON_A_GPU)
def test_every_benchmark_of_gpus_runs(name: str, tmp_path: Path) -> None:
    main(["gpu", name, "--output", str(tmp_path)])
    content = json.loads((tmp_path / "results.json").read_text(encoding="utf-8"))
    assert content["failures"] == []
    for table in content["tables"]:
        assert f"\n{table['name']}\n" in (tmp_path / "results.md").read_text(encoding="utf-8")
        assert all(min(row["values"]) > 0 for row in table["rows"])


def test_half_a_pixel_off_is_another_view() -> None:
    grid, panorama = TangentGrid(1, 6), striped_panorama(equirect_shape(6))
    ours = equirect_to_tangent(panorama, grid)
    for axis in (0, 1):
        shifted = (panorama + np.roll(panorama, 1, axis=axis)) / 2
        for name, render in rivals(shifted, grid).items():
            with pytest.raises(RuntimeError, match=f"{name} renders other views"):
                check_same_views(name, ours, render(range(grid.num_images)))


def test_regressions_are_beyond_noise() -> None:
    then = {"a": Interval(1.0, 0.9, 1.05)}
    for interval, verdict in (
        ((1.2, 1.1, 1.3), "slower"),
        ((1.2, 1.04, 1.3), "same"),
        ((1.07, 1.06, 1.08), "same"),
        ((0.8, 0.7, 0.85), "faster"),
    ):
        assert verdicts({"a": Interval(*interval)}, then) == {"a": verdict}
    names = json.loads(BASELINE.read_text(encoding="utf-8"))["quotients"]
    assert {name.partition(":")[0] for name in names} == set(MEASURED)
