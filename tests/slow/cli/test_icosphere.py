"""Signals on an icosphere, from a store to labels of new panoramas, with a network of one value."""

from __future__ import annotations

from pathlib import Path

import numpy as np

import tangent_train
from tangent_train.io.pixel_files import read_pixels, write_pixels
from tests.cli.tiny_runs import SMALL_ROOMS, Run, results
from tests.inference.trained import sphere

POINTWISE = """
_target_: torch.nn.Conv2d
in_channels: null
out_channels: 13
kernel_size: 1
"""


def test_a_run_from_the_store_labels_panoramas_of_any_size(
    rooms: str, run: Run, tmp_path: Path
) -> None:
    (tmp_path / "own/network").mkdir(parents=True)
    (tmp_path / "own/network/pointwise.yaml").write_text(POINTWISE)
    of_data = [text for text in SMALL_ROOMS if not text.startswith("trainer.")]
    data = ["data=synthrooms", rooms, *of_data, "data.cache=store", "data.inputs=[rgb]"]
    signals = ["representation=icosphere", "representation.elements=faces"]
    run("prepare", *data, *signals)
    augmented = ["representation.random_rotation=so3", "representation.mirror=true"]
    settings = [*data, *signals, *augmented, "trainer.accelerator=cpu", "trainer.max_epochs=2"]
    run("train", "--config-dir=own", "network=pointwise", *settings, "hydra.run.dir=run")
    last, trust = "checkpoint=run/checkpoints/last.ckpt", "trust=torch.nn.Conv2d"
    assert list((tmp_path / "run/panels").glob("*.png"))

    run("evaluate", *data, last, trust, "hydra.run.dir=again")
    assert results(tmp_path / "again")["confusion"] == results(tmp_path / "run")["confusion"]

    write_pixels(tmp_path / "in" / "odd.png", sphere(75))
    run("predict", last, trust, "input=in", "output=out")
    labels = read_pixels(tmp_path / "out/labels/odd.png", indices=True)
    assert labels.shape == (75, 150)
    network = tangent_train.load(tmp_path / "run/checkpoints/last.ckpt", trust=trust[6:])
    np.testing.assert_array_equal(network.labels(sphere(75)), labels)
