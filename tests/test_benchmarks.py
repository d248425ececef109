from __future__ import annotations

import io
import json
import re
import runpy
import subprocess
import sys
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy import stats
from torch import nn

from benchmarks import compare, evaluation, growth, keypoints, precision, rivals, step
from benchmarks.command import MEASURED, OTHERS, main
from benchmarks.measuring import (
    Interval,
    Options,
    Row,
    Table,
    Way,
    at_least,
    at_most,
    in_process,
    measure,
    median_interval,
    peak_kib,
)
from benchmarks.report import amount, machine, read_results, table_text, write_results
from tangent_train.errors import DataError
from tangent_train.geometry import TangentGrid, equirect_shape
from tangent_train.rendering import equirect_to_tangent


class Clock:
    """Time that passes only where it is told to."""

    def __init__(self) -> None:
        self.now = 0.0
        self.ran: list[str] = []

    def __call__(self) -> float:
        return self.now

    def way(self, name: str, *seconds: float, **more: Any) -> Way:
        """Takes so long each time, the last forever."""
        left = list(seconds)

        def run() -> None:
            self.ran.append(name)
            self.now += left.pop(0) if len(left) > 1 else left[0]

        return Way(name, run, **more)


@pytest.mark.parametrize("count", range(1, 30))
def test_the_interval_holds_the_median_with_95_percent(count: int) -> None:
    """Against the binomial distribution; an interval of one value less on both sides does not."""
    median, low, high = median_interval(range(count)[::-1])
    assert median == (count - 1) / 2
    assert low + high == count - 1
    missed = 2 * stats.binom.cdf(low, count, 0.5)
    assert missed <= 0.05 or low == 0
    narrower = 2 * stats.binom.cdf(low + 1, count, 0.5)
    assert narrower > 0.05


def test_ways_run_in_turn_every_other_round_backwards() -> None:
    clock = Clock()
    ways = [
        clock.way("a", 0.1),
        clock.way("b", 0.2, scale=5),
        clock.way("c", 2.0, rounds=1),
    ]
    rows = measure(ways, 2, clock)
    assert "".join(clock.ran) == "abc" + "ab" + "abc" + "ba", "what takes long warms up once"
    assert [row.values for row in rows] == [
        pytest.approx([0.1, 0.1]),
        pytest.approx([1, 1]),
        pytest.approx([2]),
    ]


def test_what_is_short_is_repeated_until_it_can_be_measured() -> None:
    clock = Clock()
    (row,) = measure([clock.way("a", 0.5, 0.003)], 3, clock)
    assert len(clock.ran) == 2 + 3 * 7, "0.02 s is 7 times 0.003 s; the first time compiled"
    assert row.values == pytest.approx([0.003] * 3)


def test_a_machine_that_slows_down_does_not_change_the_quotients() -> None:
    load = np.array([1, 5, 2, 3, 1.5, 9, 4])
    table = Table("t", "title", [Row("its", list(load)), Row("ours", list(2 * load), ours=True)])
    assert table.ratio("ours") == pytest.approx((2, 2, 2))
    table.rows.append(Row("rarely", [3.0]))
    assert table.ratio("rarely").median == 1
    assert table.ratio("rarely", "ours").median == 0.5


def test_goals_are_bounds() -> None:
    assert at_most("", 1.25, 1.25).met
    assert not at_most("", 1.26, 1.25).met
    assert at_least("", 20, 20).met
    assert not at_least("", 19.9, 20).met


@pytest.mark.parametrize(
    ("value", "unit", "text"),
    [
        (0.0000123, "s", "12.3 µs"),
        (0.00999, "s", "9.99 ms"),
        (1.0, "s", "1.00 s"),
        (123.4, "s", "123 s"),
        (1540.0, "MiB", "1,540 MiB"),
    ],
)
def test_amounts_have_three_digits(value: float, unit: str, text: str) -> None:
    assert amount(value, unit) == text


@pytest.mark.slow  # the other process imports all this
def test_memory_is_that_of_the_other_process() -> None:
    here = peak_kib()
    held = in_process(_peak_with, 300)
    assert held > 300 * 1024
    assert peak_kib() < here + 100 * 1024


def _peak_with(mebibytes: int) -> int:
    content = bytearray(mebibytes * 2**20)
    content[::4096] = b"x" * len(content[::4096])
    return peak_kib()


@pytest.fixture(scope="module")
def views() -> tuple[TangentGrid, NDArray[np.float32]]:
    grid = TangentGrid(1, 6)
    return grid, rivals.striped_panorama(equirect_shape(6))


def test_other_libraries_render_the_same_views(
    views: tuple[TangentGrid, NDArray[np.float32]],
) -> None:
    grid, panorama = views
    ours, faces = equirect_to_tangent(panorama, grid), range(grid.num_images)
    found = rivals.rivals(panorama, grid)
    assert [rival.name for rival in found] == ["py360convert", "pyequilib", "pytorch360convert"]
    for rival in found:
        theirs = rival.render(faces)
        rivals.check_same_views(rival.name, ours, theirs)
        with pytest.raises(RuntimeError, match="renders other views"):
            rivals.check_same_views(rival.name, np.roll(ours, 1, axis=0), theirs)


@pytest.mark.parametrize("axis", [0, 1])
def test_half_a_pixel_off_is_another_view(
    axis: int, views: tuple[TangentGrid, NDArray[np.float32]]
) -> None:
    grid, panorama = views
    ours = equirect_to_tangent(panorama, grid)
    shifted = (panorama + np.roll(panorama, 1, axis=axis)) / 2
    theirs = rivals.rivals(shifted, grid)[0].render(range(grid.num_images))
    with pytest.raises(RuntimeError, match="py360convert renders other views"):
        rivals.check_same_views("py360convert", ours, theirs)
    with pytest.raises(RuntimeError, match="30 × 30 pixels instead of 32²"):
        rivals.check_same_views("", ours, list(ours[:, 1:-1, 1:-1]))


def test_bare_loops_that_train_otherwise_are_void() -> None:
    network = nn.Conv2d(1, 2, 1)
    task: Any = type("Task", (), {"network": network, "memory_format": torch.contiguous_format})
    bare = step.BareLoop(None, task, 0.1)
    bare.check_same(network)
    with torch.no_grad():
        network.weight += 0.01
    with pytest.raises(RuntimeError, match="other weights; the comparison is void"):
        bare.check_same(network)


def test_time_in_a_network_that_sees_every_eighth_image_is_multiplied(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    clock = Clock()

    class Slow(nn.Module):
        def forward(self, images: torch.Tensor) -> dict[str, torch.Tensor]:
            clock.now += 3 * len(images)
            return {"out": 2 * images}

    monkeypatch.setattr("benchmarks.evaluation.time.perf_counter", clock)
    network = evaluation.EveryNth(Slow(), 8)
    panoramas = evaluation.PanoramaClock(network)
    panoramas.on_test_epoch_start()
    clock.now += 1
    images = torch.arange(20.0).reshape(20, 1, 1, 1)
    scores = network(images)
    assert scores.flatten().tolist() == [0] * 8 + [16] * 8 + [32] * 4
    clock.now += 4
    panoramas.on_test_batch_end()
    assert panoramas.outside_s == [5]
    assert panoramas.inside_s == [pytest.approx(3 * 20)]


def test_the_exponent_is_that_of_a_power() -> None:
    rows = [Row("", [7 * size**1.25], size=size) for size in (10.0, 100.0, 5000.0)]
    assert growth.exponent(rows) == pytest.approx(1.25)


def _tables(ours: list[float]) -> list[Table]:
    rows = [Row("its", [1.0] * len(ours)), Row("ours", ours, ours=True), Row("third", [9.0])]
    goals = [at_most("so much", 1.2, 1.25)]
    sizes = [Row(f"level {k}", [4.0**k], ours=True, size=4.0**k) for k in range(4)]
    return [
        Table("a: time", "Title, 4² to µ", rows, goals=goals, notes=["note"]),
        Table("b: growth", "Grows", sizes, "MiB"),
    ]


def test_results_are_read_as_they_were_written(tmp_path: Path) -> None:
    tables = _tables([1.1, 1.2, 1.3])
    write_results(tmp_path, tables, quick=False, on=machine())
    read, content = read_results(tmp_path / "results.json")
    assert read == tables
    assert content["machine"]["versions"]["torch"] == torch.__version__.partition("+")[0]
    text = (tmp_path / "results.md").read_text()
    assert "| ours | 1.20 s | 1.2× | 1.1 to 1.3 |" in text
    assert "- met: so much 1.2× (at most 1.25×)" in text
    heights = {}
    for name in ("a", "b"):
        picture = cv2.imread(str(tmp_path / f"{name}.png"))
        assert picture is not None
        heights[name] = len(picture)
    assert heights["a"] < heights["b"]
    assert "  ours   1.20 s         1.2×  1.1 to 1.3" in table_text(tables[0])


@pytest.mark.parametrize("text", [None, "{", "[]", '{"tables": [{"name": 1}]}'])
def test_what_are_no_results_is_said(text: str | None, tmp_path: Path) -> None:
    path = tmp_path / "results.json"
    if text is not None:
        path.write_text(text)
    with pytest.raises(DataError, match=r"results\.json: found .* make bench"):
        read_results(path)
    with pytest.raises(SystemExit, match=r"benchmarks: .*results\.json: found"):
        main(["baseline", str(path)])


def _verdict(now: list[float], then: Interval) -> str:
    (change,) = compare.changes(_tables(now)[:1], {"a: time: ours": then})
    return change.verdict


def test_regressions_are_beyond_noise() -> None:
    then = Interval(1.0, 0.9, 1.05)
    assert _verdict([1.2, 1.2, 1.3], then) == "slower"
    assert _verdict([1.04, 1.2, 1.3], then) == "same", "it may have been as fast"
    assert _verdict([1.06, 1.07, 1.08], then) == "same", "less than a tenth"
    assert _verdict([0.8, 0.7, 0.8], then) == "faster"
    names = [(c.name, c.verdict) for c in compare.changes(_tables([1.0]), {"x": then})]
    assert names[:2] == [("x", "not measured"), ("a: time: ours", "new")]


def test_a_baseline_holds_the_quotients_of_several_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    files = []
    for run, ours in enumerate(([1.0, 1.1, 1.2], [1.3, 1.4, 1.5], [1.1, 1.2, 1.3])):
        write_results(tmp_path / str(run), _tables(ours)[:1], quick=False, on=machine())
        files.append(tmp_path / str(run) / "results.json")
    path = tmp_path / "baseline.json"
    compare.write_baseline(files, path)
    rows, content = compare.read_baseline(path)
    assert rows == {"a: time: ours": Interval(1.2, 1.0, 1.5)}
    assert content["runs"] == 3
    monkeypatch.setattr(compare, "BASELINE", path)
    monkeypatch.setattr("benchmarks.command.read_baseline", lambda: compare.read_baseline(path))
    main(["compare", str(files[1])])
    assert "Nothing has become slower" in capsys.readouterr().out
    write_results(tmp_path / "slow", _tables([1.6, 1.7, 1.8])[:1], quick=False, on=machine())
    with pytest.raises(SystemExit, match="1 of 1 have become slower"):
        main(["compare", str(tmp_path / "slow" / "results.json")])
    printed = capsys.readouterr().out
    assert re.search(r"a: time: ours +1\.2 \(1 to 1\.5\) +1\.7 \(1\.6 to 1\.8\) +slower", printed)
    write_results(tmp_path / "quick", _tables([1.0])[:1], quick=True, on=machine())
    for command in ("compare", "baseline"):
        with pytest.raises(SystemExit, match="found a run with --quick"):
            main([command, str(tmp_path / "quick" / "results.json")])


def test_the_baseline_that_is_shipped_is_of_what_is_measured() -> None:
    """Every benchmark with a rival is in it, and quotients only."""
    rows, content = compare.read_baseline()
    assert set(content) == {"cores", "runs"}
    assert {name.partition(":")[0] for name in rows} == set(MEASURED)
    for name, (median, low, high) in rows.items():
        assert 0 < low <= median <= high, name


@pytest.mark.slow
@pytest.mark.parametrize("name", MEASURED)
def test_every_benchmark_measures_its_rows(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    main([name, "--quick", "--rounds", "1", "--output", str(tmp_path)])
    tables, content = read_results(tmp_path / "results.json")
    assert content["quick"]
    assert all(table.name.startswith(f"{name}: ") for table in tables)
    assert len({table.name for table in tables}) == len(tables)
    for table in tables:
        assert any(row.ours for row in table.rows)
        for row in table.rows:
            assert min(row.values) > 0, (table.name, row.name)
    assert (tmp_path / f"{name}.png").exists()
    printed = capsys.readouterr().out
    assert re.search(r"\d+ of \d+ goals met", printed)
    assert tables[0].title in printed


@pytest.mark.slow
def test_precision_is_compared_on_a_cpu_as_well(capsys: pytest.CaptureFixture[str]) -> None:
    precision.main(["--quick"])
    printed = capsys.readouterr().out
    assert re.search(r"float32 +[\d.,]+ m?s +1×\n  bf16, channels last +[\d.,]+ m?s", printed)


@pytest.mark.slow
def test_the_keypoint_benchmark_finds_keypoints_in_all_ways(
    capsys: pytest.CaptureFixture[str],
) -> None:
    keypoints.main(["--quick"])
    counts = re.findall(r"(\d+) keypoints +[\d.]+ m?s", capsys.readouterr().out)
    assert len(counts) == 8
    assert min(map(int, counts)) > 100


def test_one_benchmark_is_run_by_its_name(monkeypatch: pytest.MonkeyPatch) -> None:
    def run(*arguments: str) -> str:
        monkeypatch.setattr(sys, "argv", ["benchmarks", *arguments])
        printed = io.StringIO()
        with redirect_stdout(printed), pytest.raises(SystemExit) as ended:
            runpy.run_module("benchmarks", run_name="__main__")
        return printed.getvalue() + ("" if ended.value.code == 0 else str(ended.value.code))

    assert "found 'speed'; expected one of images, labels," in run("speed")
    assert "found 0; expected 1 or more" in run("images", "--rounds", "0")
    assert "python -m benchmarks baseline results.json" in run("--help")
    for name in OTHERS:
        assert f"python -m benchmarks {name}" in run(name, "--help").replace("\n", " ")


HEAVY = {"torch", "lightning", "cv2", "numba", "torchvision", "scipy", "matplotlib", "trimesh"}
COMMANDS = ("train", "evaluate", "predict", "render", "export", "prepare", "keypoints", "transfer")


def test_no_command_imports_anything_heavy_to_say_what_it_does(tmp_path: Path) -> None:
    code = f"""
import sys
from hydra.core.global_hydra import GlobalHydra
from tangent_train.cli import main
for name in {COMMANDS}:
    sys.argv = ["tangent-" + name, "--help"]
    getattr(main, name)()
    GlobalHydra.instance().clear()
    heavy = {HEAVY} & set(sys.modules)
    assert not heavy, (name, heavy)
"""
    done = subprocess.run(
        [sys.executable, "-c", code], check=False, cwd=tmp_path, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("Groups") >= 1


def test_quick_is_for_seeing_it_run() -> None:
    assert Options().times(7) == 7
    assert Options(quick=True).times(7) == 2
    assert Options(quick=True, rounds=1).times(7) == 1
    assert json.loads(json.dumps(machine()))["cores"] >= 1
