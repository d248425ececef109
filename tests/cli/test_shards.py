"""Shards of predictions: each image once, and the same result as without shards."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from tangent_train.io.pixel_files import write_pixels
from tests.cli.tiny_runs import Predict
from tests.datamodules.data_files import contents
from tests.inference.trained import sphere

RunShard = Callable[..., str]
NAMES = ("a", "b/a", "b/b", "c", "d", "e", "f")


@pytest.fixture
def run_shard(tmp_path: Path, predict: Predict, capsys: pytest.CaptureFixture[str]) -> RunShard:
    """Run the command on seven panoramas, of which the fifth is broken; return its output."""
    for number, name in enumerate(NAMES):
        write_pixels(tmp_path / "in" / f"{name}.png", np.roll(sphere(16), number, 1))
    (tmp_path / "in" / "d.png").write_bytes(b"broken")
    given = {"write": "[labels]", "blend": "nearest"}

    def typed(output: str, *shard: int, **settings: Any) -> str:
        if shard:
            settings["shard"] = "{}/{}".format(*shard)
        capsys.readouterr()
        try:
            predict(**given | {"output": output} | settings)
        except SystemExit as ended:
            return capsys.readouterr().out + str(ended.code)
        return capsys.readouterr().out

    return typed


def results(folder: str) -> dict[str, bytes]:
    """All files but those of the manifest, and the report, which has a date."""
    files = contents(Path(folder)).items()
    others = "finished", "report.html"
    return {name: content for name, content in files if not name.startswith(others)}


def test_shards_give_what_one_command_gives(run_shard: RunShard) -> None:
    assert "1 of 7 images could not be used" in run_shard("whole", report=3)
    printed = [run_shard("out", n, 3, report=3) for n in (3, 2, 1)]
    assert sum("could not be used" in text for text in printed) == 1
    assert not (Path("out") / "summary.json").exists(), "a shard has failed"
    # The command without a shard retries the broken image, and writes the summary.
    assert "7 images, 6 done already" in run_shard("out", report=3)
    assert results("out") == results("whole")


def test_a_shard_is_continued_and_the_last_one_writes_the_summary(run_shard: RunShard) -> None:
    (Path("in") / "d.png").unlink()
    run_shard("out", 1, 2)
    assert "is done: 3 of 6 images" in run_shard("out", 1, 2)
    assert "3 images, 0 done already" in run_shard("out", 2, 2)
    entries = json.loads((Path("out") / "summary.json").read_text())["images"]
    assert [entry["name"] for entry in entries] == [name for name in NAMES if name != "d"]
    assert "blend: found feather; expected nearest" in run_shard("out", 1, 2, blend="feather")
    assert "shard: found 3/2" in run_shard("out", 3, 2)


def test_masked_pixels_are_unknown_and_have_no_share(run_shard: RunShard) -> None:
    """The labels are read by another program."""
    run_shard("plain")
    counts = np.ones((16, 32), bool)
    counts[11:], counts[:, 29:], counts[:, :2] = False, False, False
    for name in NAMES:
        write_pixels(Path(f"masks/{name}.png"), counts.repeat(2, 0).repeat(2, 1).astype(np.uint8))
    run_shard("masked", mask="masks")
    for entry in json.loads(Path("masked/summary.json").read_text())["images"]:
        if "error" in entry:
            continue
        paths = (Path(folder, "labels", f"{entry['name']}.png") for folder in ("plain", "masked"))
        plain, found = (np.array(Image.open(path)) for path in paths)
        np.testing.assert_array_equal(found, np.where(counts, plain, 0))
        weights = np.cos(np.radians(90 - (np.arange(16) + 0.5) * 180 / 16))[:, None] * counts
        shares = [weights[found == value].sum() / weights.sum() for value in (0, 1, 2, 3)]
        assert list(entry["classes"].values()) == pytest.approx(shares, abs=1e-3)
