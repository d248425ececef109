"""Impossible settings are refused by name, with a remedy, before data is generated or read."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.cli.tiny_runs import run_command

ROOMS = ("train", "experiment=rooms/demo")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((*ROOMS, "data.inputs=[depth,rgbd]"), r"data\.inputs: found .*; expected a list: rgb"),
        (
            ("train", "experiment=shapes/default", "task=segmentation"),
            r"task: found segmentation, .*; expected classification",
        ),
        ((*ROOMS, "network._target_=no.such.Net"), r"network\._target_: found no\.such\.Net, .*P"),
        ((*ROOMS, "network=fcn_resnet", "network.depth=77"), r"depth: found 77; expected 50 or 1"),
        ((*ROOMS, "data.rooms.height=7"), r"height: found 7; expected"),
        ((*ROOMS, "panels=-1"), r"panels: found -1; expected 0 or more"),
        (
            (*ROOMS, "trainer=ddp", "trainer.accelerator=cpu", "trainer.sync_batchnorm=true"),
            r"trainer\.sync_batchnorm: found true, on a CPU; expected false",
        ),
        ((*ROOMS, "hydra.run.dir=image.png/run"), r"image\.png/run: found not a directory; expect"),
        (("train", "level=${oc.env:NOT_SET}"), r"Environment variable 'NOT_SET' not found"),
        (("evaluate",), r"checkpoint: found none; expected checkpoints/best"),
        (("evaluate", "checkpoint=."), r"found a folder; .*checkpoints/best\.ckpt"),
        (("train", "resume=nowhere"), r"nowhere: found no checkpoints/last\.ckpt; expected"),
        (("train", "data=stanford2d3ds", "data.root=nowhere"), r"nowhere.*: found .*; expected"),
        (("report", "nowhere"), r"nowhere: found no such folder; expected a run"),
        (
            ("render", "input=image.png", "output=o", "base_level=x"),
            r"base_level: found x; expected",
        ),
        (("transfer", "experiment=rooms/transfer", "level=3"), r"stage S: image size .*found 4×4"),
        (("keypoints", "output=o", "base_level=[0,x]"), r"base_level: found .*; expected"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, tuple) else "",
)
def test_impossible_settings(
    arguments: tuple[str, ...], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "image.png").touch()
    command, *rest = arguments
    with pytest.raises(SystemExit, match=rf"(?s)^tangent-{command}: .*{message}"):
        run_command(monkeypatch, command, *rest)
    assert not (tmp_path / "data").exists(), "nothing is generated"
