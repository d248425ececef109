from __future__ import annotations

import re
import runpy
import sys

import pytest

from benchmarks import costs, keypoints, loader, memory, rendering, training


@pytest.mark.slow
def test_the_benchmark_runs_and_both_ways_agree(capsys: pytest.CaptureFixture[str]) -> None:
    rendering.main(["--quick"])
    printed = capsys.readouterr().out
    for row in ("bare cv2.remap", "equirect_to_tangent, 4 images", "owners", "tangent_to_labels"):
        assert row in printed
    plain, careful = (
        float(word.rstrip("%"))
        for word in printed.partition("labels agree")[2].splitlines()[0].split()
        if word.endswith("%")
    )
    assert min(plain, careful) > 99.5


@pytest.mark.slow
def test_the_loader_benchmark_measures_both_ways(capsys: pytest.CaptureFixture[str]) -> None:
    loader.main(["--quick"])
    printed = capsys.readouterr().out
    png, store, first = map(float, re.findall(r"([\d.]+) samples/s", printed))
    assert min(png, store, first) > 0
    assert len(re.findall(r"worker: \d+ MB of its own, \d+ MB at most", printed)) == 2
    assert re.search(r"80 of 80 images .* as long", printed)


@pytest.mark.slow
def test_chunks_need_less_memory_than_the_batch(capsys: pytest.CaptureFixture[str]) -> None:
    memory.main(["--quick"])
    one, batch = map(float, re.findall(r"(\d+) MiB", capsys.readouterr().out))
    assert one < batch


@pytest.mark.slow
def test_the_training_benchmark_steps_in_both_precisions(
    capsys: pytest.CaptureFixture[str],
) -> None:
    training.main(["--quick"])
    assert len(re.findall(r"ms +[\d.]+× as fast", capsys.readouterr().out)) == 2


@pytest.mark.slow
def test_the_keypoint_benchmark_finds_keypoints_in_all_ways(
    capsys: pytest.CaptureFixture[str],
) -> None:
    keypoints.main(["--quick"])
    counts = re.findall(r"(\d+) keypoints +[\d.]+ ms", capsys.readouterr().out)
    assert len(counts) == 8
    assert min(map(int, counts)) > 100


@pytest.mark.slow
def test_the_costs_are_those_of_what_was_added(capsys: pytest.CaptureFixture[str]) -> None:
    costs.main(["--quick"])
    found = re.findall(
        r"^  (.+?) +([\d,]+) parameters +([\d.]+) ms +([\d.]+)× +(\d+) MiB$",
        capsys.readouterr().out,
        re.MULTILINE,
    )
    assert [name for name, *_ in found] == list(costs.ADDITIONS)
    parameters = {name: int(count.replace(",", "")) for name, count, *_ in found}
    plain, head, attention = (
        parameters[name] for name in ("plain", "auxiliary head", "auxiliary head, attention")
    )
    assert plain < head < attention
    assert parameters["elevation"] == plain + 3 * 3 * 16, "one more plane of the first convolution"
    assert parameters["Lovász"] == parameters["average of the weights"] == plain
    assert float(found[0][3]) == 1
    assert min(float(milliseconds) for _, _, milliseconds, *_ in found) > 0
    mebibytes = {name: int(memory) for name, *_, memory in found}
    assert mebibytes["10 images at once"] <= 1.1 * mebibytes["plain"]


def test_one_benchmark_is_run_by_its_name(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def run(*arguments: str) -> None:
        monkeypatch.setattr(sys, "argv", ["benchmarks", *arguments])
        runpy.run_module("benchmarks", run_name="__main__")

    with pytest.raises(SystemExit, match="found 'speed'; expected one of rendering,"):
        run("speed")
    with pytest.raises(SystemExit) as ended:
        run("accuracy", "--help")
    assert ended.value.code == 0
    assert "few_attention_so3" in capsys.readouterr().out.replace("\n", "")
