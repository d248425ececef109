"""Predicted depth is read where true depth is: by data sets, renderings, networks."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from datamodules.folder.labeled import FolderPanoramas
from tangent_train.io.pixel_files import read_depth_m, write_pixels
from tests.cli.tiny_runs import Run, predicted, run_command
from tests.inference.trained import sphere, write_checkpoint, write_depth_checkpoint

ROWS = 64


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Run:
    """Runs a command in this process, in a folder with panoramas ``in`` and a depth network."""
    monkeypatch.chdir(tmp_path)
    write_depth_checkpoint(tmp_path / "depth.ckpt")
    for number, name in enumerate(("hall", "flat/kitchen")):
        write_pixels(tmp_path / "in" / f"{name}.png", np.roll(sphere(ROWS), 9 * number, axis=1))

    def run(command: str, *arguments: str) -> None:
        run_command(monkeypatch, command, *arguments)

    return run


@pytest.mark.parametrize("kind", ["png", "exr"])
def test_folders_of_images_with_depth(run: Run, tmp_path: Path, kind: str) -> None:
    run("predict", "checkpoint=depth.ckpt", "input=in", "output=out", f"depth_format={kind}")
    root = tmp_path / "rooms"
    shutil.copytree("in", root / "images")
    shutil.copytree("out/depth", root / "depth")
    (root / "classes.json").write_text('["wall"]')
    data = FolderPanoramas(root, labels="distance", level=2)
    files = [one for found in data.files().values() for one in found]
    assert sorted(one.name for one in files) == ["flat/kitchen", "hall"]
    for one in files:
        expected = read_depth_m(tmp_path / "out" / "depth" / f"{one.name}.{kind}", 1000)
        np.testing.assert_allclose(data.decode_depth(one) / 512, expected, atol=1 / 1024 + 1e-6)
    write_checkpoint(tmp_path / "rgbd.ckpt", channels=4)
    run("predict", "checkpoint=rgbd.ckpt", "input=in", "output=labels", "depth=out/depth")
    assert predicted(Path("labels")).keys() == {"hall", "flat/kitchen"}
