"""Transfers that start from a given network."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from hydra import compose, initialize_config_dir
from omegaconf import DictConfig

from datamodules import SynthRooms
from tangent_train.cli.compose import config_folder
from tangent_train.cli.transfer.given import check_given
from tangent_train.errors import SettingError
from tests.cli.transfer.pretended_runs import PretendedRuns, run_transfer


@pytest.fixture(scope="module")
def rooms() -> DictConfig:
    with initialize_config_dir(str(config_folder()), version_base="1.3"):
        return compose("transfer", ["experiment=rooms/transfer"])


def _checkpoint(path: Path, **changes: Any) -> Path:
    network = {"_target_": "models.UNet", "in_channels": None, "num_classes": None}
    config: dict[str, Any] = {
        "network": {**network, "widths": [16, 32, 64, 128, 256]},
        "data": {
            "_target_": "datamodules.SynthRoomsPerspective",
            "inputs": ["rgb", "depth"],
            "fold": 1,
        },
    }
    content: dict[str, Any] = {
        "kind": "segmentation",
        "class_names": list(SynthRooms.class_names),
        "inputs": config["data"]["inputs"],
        "normalization": {"mean": [0.0] * 4, "std": [1.0] * 4},
        "state_dict": {},
        "config": config,
    }
    for name, value in changes.items():
        section, _, setting = name.partition("__")
        (config[section] if setting else content)[setting or section] = value
    torch.save(content, path)
    return path


def test_a_given_network_is_not_trained(
    runs: PretendedRuns, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    given = _checkpoint(tmp_path / "given.ckpt")
    run_transfer(monkeypatch, "checkpoint=given.ckpt", "compare=[]")
    assert runs.started[:2] == [("evaluate", "P"), ("evaluate", "S")]
    assert runs.configs[0].checkpoint == runs.configs[2].init_from == str(given)
    run_transfer(monkeypatch, "checkpoint=given.ckpt", "compare=[]", "optimizer.lr=3e-3")
    assert len(runs.started) == 4
    with pytest.raises(SystemExit, match="seed_0/P: found stage P of another network"):
        run_transfer(monkeypatch, "compare=[]")


@pytest.mark.parametrize(
    ("changes", "folds", "message"),
    [
        ({"network__widths": [4, 8]}, [1], r"network\.widths=\[4, 8\]; expected \[16, 32"),
        ({"network___target_": "x.Y"}, [1], r"network\._target_='x\.Y'"),
        ({"data__inputs": ["rgb"]}, [1], r"data\.inputs=\['rgb'\]; expected \['rgb', 'depth'\]"),
        ({"data__fold": 2}, [1], r"testing on fold 2.*; expected folds=\[2\]"),
        ({}, [1, 2], r"testing on fold 1.*; expected folds=\[1\]"),
        (
            {"class_names": ["unknown", "sky", "road"]},
            [1],
            "a network for unknown, sky, road; expected one for unknown, beam, .*, the classes of "
            r"datamodules\.SynthRooms",
        ),
        ({"kind": "classification"}, [1], "a network for classification; .* for segmentation"),
    ],
)
def test_a_network_that_does_not_fit_is_refused(
    rooms: DictConfig, changes: dict[str, Any], folds: list[int], message: str, tmp_path: Path
) -> None:
    config = rooms.copy()
    config.checkpoint = str(_checkpoint(tmp_path / "given.ckpt", **changes))
    with pytest.raises(SettingError, match=rf"^checkpoint=.*given\.ckpt: found .*{message}"):
        check_given(config, folds)


def test_a_network_that_fits(rooms: DictConfig, tmp_path: Path) -> None:
    config = rooms.copy()
    config.checkpoint = str(_checkpoint(tmp_path / "given.ckpt", network__weights="coco"))
    check_given(config, [1])
