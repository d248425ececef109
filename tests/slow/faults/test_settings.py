"""Settings that cannot work are refused before any data is made or read, by name, with a remedy."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
import torch

from tangent_train.cli import main
from tests.inference.trained import write_checkpoint

ROOMS = ("train", "experiment=rooms/demo")
PREDICT = ("predict", "checkpoint=x.ckpt", "input=image.png", "output=labels")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        # Levels and images.
        (("train", "level=2", "representation.base_level=2"), r"dim: found 1; expected at least 2"),
        (("train", "level=2", "representation.base_level=3"), r"base_level: found 3; .* level = 2"),
        (("train", "representation.dim=3"), r"dim: found 3; expected at least 24"),
        (("train", "level=4"), r"image size for the UNet: found 16×16; .*multiples of 32"),
        (
            (*ROOMS, "representation.faces_per_panorama=99"),
            r"representation\.faces_per_panorama: found 99; expected 1 to 20",
        ),
        ((*ROOMS, "representation.faces_per_panorama=0"), r"faces_per_panorama: found 0; exp"),
        (("train", "representation.rotation=any"), r"\.rotation: found 'any'; .*'yaw' or 'so3'"),
        # Classes, inputs and networks.
        ((*ROOMS, "network.num_classes=5"), r"scores of the network: found .*5.*; expected .*14"),
        ((*ROOMS, "network.in_channels=3"), r"network: found UNet, which does not take .*4, "),
        (
            (*ROOMS, "data.inputs=[rgb]", "network.in_channels=4"),
            r"network: found UNet, which does not take \(1, 3, 48, 48\)",
        ),
        ((*ROOMS, "data.inputs=[depth,rgbd]"), r"data\.inputs: found .*; expected a list: rgb"),
        ((*ROOMS, "task.class_weights=[1,2]"), r"class_weights: found \[1, 2\]; .*14 numbers"),
        ((*ROOMS, "task.class_weights=logg"), r"class_weights: found logg; expected .*log, sqrt"),
        ((*ROOMS, "task=classification"), r"task: found classification, .*; expected segm"),
        (
            ("train", "experiment=shapes/default", "task=segmentation"),
            r"task: found segmentation, .*; expected classification",
        ),
        ((*ROOMS, "network._target_=no.such.Net"), r"network\._target_: found no\.such\.Net, .*P"),
        ((*ROOMS, "network=fcn_resnet", "network.depth=77"), r"depth: found 77; expected 50 or 1"),
        # Folds and amounts.
        ((*ROOMS, "data.fold=4"), r"data\.fold: found 4; expected 1, 2 or 3"),
        ((*ROOMS, "data.panoramas_per_step=0"), r"panoramas_per_step: found 0; expected 1 or"),
        ((*ROOMS, "data.validation_fraction=1"), r"validation_fraction: found 1; expected 0 to b"),
        ((*ROOMS, "data.rooms.height=7"), r"height: found 7; expected"),
        # Training.
        ((*ROOMS, "task.label_smoothing=2"), r"label_smoothing: found 2; expected 0 to 1"),
        ((*ROOMS, "task.images_per_chunk=0"), r"images_per_chunk: found 0; expected from 1"),
        ((*ROOMS, "ema=2"), r"ema: found 2; expected a decay"),
        ((*ROOMS, "panels=-1"), r"panels: found -1; expected 0 or more"),
        ((*ROOMS, "checkpoint_every_n_steps=0"), r"checkpoint_every_n_steps: found 0; expected"),
        (
            (*ROOMS, "trainer=ddp", "trainer.accelerator=cpu", "trainer.sync_batchnorm=true"),
            r"trainer\.sync_batchnorm: found true, on a CPU; expected false",
        ),
        ((*ROOMS, "hydra.run.dir=image.png/run"), r"image\.png/run: found not a directory; expect"),
        (("train", "levl=3"), r"Could not override 'levl'.*Key 'levl' is not in struct"),
        (("train", "level=${oc.env:NOT_SET}"), r"Environment variable 'NOT_SET' not found"),
        # Files.
        (("evaluate", "checkpoint=nowhere.ckpt"), r"nowhere\.ckpt: found no such file; expected"),
        (("evaluate",), r"checkpoint: found none; expected checkpoints/best"),
        (("evaluate", "checkpoint=."), r"found a folder; .*checkpoints/best\.ckpt"),
        ((*ROOMS, "init_from=nowhere.ckpt"), r"nowhere\.ckpt: found no such file; expected"),
        ((*ROOMS, "init_from=x.ckpt"), r"x\.ckpt: found no tensor that fits.*; expected"),
        (("train", "resume=nowhere"), r"nowhere: found no checkpoints/last\.ckpt; expected"),
        (("train", "data=stanford2d3ds", "data.root=nowhere"), r"nowhere.*: found .*; expected"),
        (("predict", "checkpoint=x.ckpt", "input=image.png"), r"output: found none; expected"),
        (("predict", "checkpoint=x.ckpt", "input=nothing", "output=o"), r"nothing: found nothing"),
        ((*PREDICT, "blend=soft"), r"blend: found soft; expected feather or nearest"),
        ((*PREDICT, "depth=."), r"depth: found \.; expected null for a network that takes rgb"),
        (("export", "checkpoint=x.ckpt", "output=net.doc"), r"output: found net\.doc; expected"),
        (("report", "nowhere"), r"nowhere: found no such folder; expected a run"),
        (
            ("render", "input=image.png", "output=o", "base_level=x"),
            r"base_level: found x; expected",
        ),
        ((*PREDICT, "device=quantum"), r"device: found quantum .*; expected cpu, or a device"),
        ((*PREDICT, "base_level=7"), r"base_level: found 7; expected 0 to level = 4"),
        (("transfer", "experiment=rooms/transfer", "level=3"), r"stage S: image size .*found 4×4"),
        (("keypoints", "output=o", "base_level=[0,x]"), r"base_level: found .*; expected"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, tuple) else "",
)
def test_impossible_settings(
    arguments: tuple[str, ...], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    write_checkpoint(tmp_path / "x.ckpt")
    (tmp_path / "image.png").touch()
    command, *rest = arguments
    monkeypatch.setattr(sys, "argv", [f"tangent-{command}", *rest])
    with pytest.raises(SystemExit, match=rf"(?s)^tangent-{command}: .*{message}"):
        getattr(main, command)()
    assert not (tmp_path / "data").exists(), "nothing is made"


def test_a_network_for_more_inputs_than_the_data_has(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An RGB-D network on data of colours only."""
    path = write_checkpoint(tmp_path / "x.ckpt", channels=4)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "image.png").touch()
    monkeypatch.setattr(sys, "argv", ["tangent-predict", *PREDICT[1:]])
    with pytest.raises(SystemExit, match=r"depth: found none; expected a folder"):
        main.predict()
    content = torch.load(path, weights_only=True)
    assert content["state_dict"]["network.weight"].shape[1] == 4
