"""Shards of predictions: each image once, and the same result as without shards."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from tangent_train.inference.images import read_panorama
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
    """All files but those of the shards."""
    return {name: b for name, b in contents(Path(folder)).items() if not name.startswith("shards/")}


@pytest.mark.parametrize("count", [3, 9])
def test_shards_give_what_one_command_gives(count: int, run_shard: RunShard) -> None:
    assert "1 of 7 images could not be used" in run_shard("whole", report=3)
    broken = [
        "could not be used" in run_shard("out", n, count, report=3) for n in range(2, count + 1)
    ]
    assert not (Path("out") / "summary.json").exists()
    assert f"{-(-7 // count)} image" in run_shard("out", 1, count, report=3)
    assert broken.count(True) == (count > 1)
    assert results("out") == results("whole")
    of_shards = [json.loads(text) for text in contents(Path("out/shards")).values()]
    assert len(of_shards) == count
    done = [entry["name"] for content in of_shards for entry in content["images"]]
    assert sorted(done) == sorted(NAMES)
    lengths = [len(content["images"]) for content in of_shards]
    assert max(lengths) - min(lengths) <= 1


def test_an_interrupted_shard_resumes(run_shard: RunShard, monkeypatch: pytest.MonkeyPatch) -> None:
    run_shard("whole")

    def interrupted(path: Path, *args: Any) -> Any:
        if path.name == "e.png":
            raise KeyboardInterrupt
        return read_panorama(path, *args)

    monkeypatch.setattr("tangent_train.cli.predict.read_panorama", interrupted)
    assert "Continue with resume=true" in run_shard("out", 2, 2)
    monkeypatch.setattr("tangent_train.cli.predict.read_panorama", read_panorama)
    before = {path: path.stat().st_mtime_ns for path in Path("out").rglob("*.png")}
    assert {path.stem for path in before} == {"a", "c"}
    assert "1 of 2 in all" in run_shard("out", 1, 2, resume="true")
    assert "shard: found 2/2, which has out/shards/2-of-2.json" in run_shard("out", 2, 2)
    assert "3 images, 2 done already" in run_shard("out", 2, 2, resume="true")
    assert {path: path.stat().st_mtime_ns for path in before} == before
    assert results("out") == results("whole")
    run_shard("out", 2, 2, resume="true")  # as a scheduler may start it again
    assert results("out") == results("whole")


@pytest.mark.parametrize("shard", ["17/16", "0/16", "1/2/3"])
def test_there_is_no_such_shard(shard: str, run_shard: RunShard) -> None:
    assert f"shard: found {shard}; expected number/count, such" in run_shard("out", shard=shard)
    assert not Path("out").exists()


def test_shards_that_do_not_belong_together_are_refused(run_shard: RunShard) -> None:
    run_shard("out", 1, 3)
    kept = contents(Path("out"))
    changes: dict[str, dict[str, Any]] = {
        "found shards=4 than those of out/shards/1-of-3.json (3)": {"shard": "2/4"},
        "found rotations=2 than those of out/shards/1-of-3.json (1)": {"rotations": 2},
        "found write=['color'] than": {"write": "[color]"},
        "found images of other names than those of": {"input": "in/b"},
    }
    for message, settings in changes.items():
        assert message in run_shard("out", **({"shard": "2/3"} | settings))
        assert "expected a folder without earlier results" in run_shard("out")
        assert contents(Path("out")) == kept
    assert "resume: found rotations=2" in run_shard("out", 1, 3, rotations=2, resume="true")
    assert contents(Path("out")) == kept
    run_shard("whole")
    assert "expected a folder without earlier results" in run_shard("whole", 1, 2)


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
