"""Finished runs, found and read."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from tangent_train.errors import DataError
from tangent_train.results.evaluation import find_runs, load_result
from tests.results.example_results import example_result, write_run

SCORES = (0.1, 0.2, None)


def test_a_result_is_read_as_it_was_written(tmp_path: Path) -> None:
    result = example_result(SCORES, bands=(0.5, 0.25))
    result = replace(result, intervals={"miou": (0.125, 0.5), "macc_solid_angle": (0.0, 1.0)})
    result = replace(result, folds=(4, 5))
    read = load_result(write_run(tmp_path / "a", result))
    assert read.json() == result.json()
    assert read.columns == result.columns
    assert read.settings == result.settings
    assert (read.fold, read.seed, [*read.folds]) == (1, 0, [4, 5])


def test_runs_are_found_once_and_unfinished_ones_named(tmp_path: Path) -> None:
    for name in ("b", "a"):
        write_run(tmp_path / name, example_result(SCORES))
    (tmp_path / "cut" / "checkpoints").mkdir(parents=True)
    found, begun = find_runs([tmp_path / "b", tmp_path])
    assert [path.name for path in found] == ["b", "a"]
    assert begun == [(tmp_path / "cut").resolve()]
    with pytest.raises(DataError, match=r"cut/results.json: .*tangent-train resume=.*cut"):
        find_runs([tmp_path / "cut"])


@pytest.mark.parametrize("content", [None, "[]", '{"noun": "pairs"}', "[" * 100_000])
def test_broken_results_are_named(content: str | None, tmp_path: Path) -> None:
    path = write_run(tmp_path / "a", example_result(SCORES)) / "results.json"
    path.unlink()
    if content is not None:
        path.write_text(content)
    with pytest.raises(DataError, match=r"a/results\.json: found "):
        load_result(path.parent)
