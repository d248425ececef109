"""The stages of a transfer and their configs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from hydra import initialize_config_dir
from omegaconf import DictConfig, OmegaConf

from tangent_train.cli.compose import compose_option, config_folder
from tangent_train.cli.transfer_stages import Stage, plan
from tangent_train.errors import SettingError
from tests.running import composed

FOLDER = Path("/runs/mine")


@pytest.fixture(scope="module")
def rooms() -> DictConfig:
    """With the settings below, however the experiment is tuned."""
    fixed = ("level=7", "data.rooms.height=256", "fine_tuning.epochs=[1,10]", "seed=3")
    rates = ("optimizer=adamw", "optimizer.lr=3e-3", "scheduler@fine_tuning.scheduler=constant")
    epochs = ("scheduler=one_cycle", "trainer.max_epochs=20")
    return composed("transfer", "experiment=rooms/transfer", *fixed, *rates, *epochs)


@pytest.fixture(scope="module")
def compared() -> dict[str, dict[str, Any]]:
    with initialize_config_dir(str(config_folder()), version_base="1.3"):
        return {name: compose_option("representation", name) for name in ("erp", "cubemap")}


def _stages(config: DictConfig, compared: Any = (), **settings: Any) -> dict[str, Stage]:
    config = config.copy()
    for name, value in settings.items():
        OmegaConf.update(config, name.replace("__", "."), value, force_add=True)
    return {stage.name: stage for stage in plan(config, FOLDER, dict(compared))}


def test_the_stages_in_their_order(rooms: DictConfig, compared: dict[str, Any]) -> None:
    stages = _stages(rooms, compared, folds=[2]).values()
    assert [(s.name, s.command, s.weights and s.weights.name) for s in stages] == [
        ("P", "train", None),
        ("S", "evaluate", "P"),
        ("S-erp", "evaluate", "P"),
        ("S-cubemap", "evaluate", "P"),
        ("P-FT-1", "train", "P"),
        ("S-FT-1", "train", "P"),
        ("P-FT-10", "train", "P"),
        ("S-FT-10", "train", "P"),
    ]
    assert all(s.folder == FOLDER / "fold_2" / "seed_3" / s.name for s in stages)
    ordinary = set(composed("train")) - {"sweep", "launcher", "trust"}
    for stage in stages:
        config, photos = stage.config, stage.name[0] == "P"
        assert set(config) == ordinary
        assert (config["seed"], config["data"]["seed"], config["data"]["fold"]) == (3, 3, 2)
        assert config["name"] == f"rooms/transfer/{stage.name}"
        assert config["data"]["_target_"].endswith("Perspective") == photos
        assert config["representation"]["_target_"].endswith("PerspectiveRepresentation") == photos
        assert config["data"]["root"] == "data/rooms_transfer"
        assert config["data"].get("stream", 0) == ("P-FT" in stage.name), "other crops"


def test_fine_tuning_takes_a_tenth_of_the_rate(rooms: DictConfig) -> None:
    stages = _stages(rooms, fine_tuning__scheduler={"max_lr": "${optimizer.lr}"})
    tuned, first = stages["S-FT-10"].config, stages["P"].config
    assert tuned["optimizer"] == {**first["optimizer"], "lr": 3e-4}
    assert tuned["scheduler"]["max_lr"] == 3e-4, "of fine-tuning, not of P"
    assert tuned["scheduler"]["_target_"].endswith("ConstantLR")
    assert tuned["trainer"]["max_epochs"] == 10
    assert (first["optimizer"]["lr"], first["trainer"]["max_epochs"]) == (3e-3, 20)
    assert first["scheduler"]["_target_"].endswith("OneCycleLR")
    with pytest.raises(SettingError, match=r"fine_tuning\.optimizer\.lr: found null, a tenth"):
        _stages(rooms, optimizer__lr=None)


def test_fine_tuning_with_an_optimizer_of_its_own(rooms: DictConfig) -> None:
    own = {"_target_": "torch.optim.SGD", "_partial_": True, "lr": "${optimizer.lr}"}
    tuned = _stages(rooms, fine_tuning__optimizer=own)["P-FT-1"].config
    assert tuned["optimizer"] == {**own, "lr": 3e-3}, "AdamW's settings are not SGD's"


def test_other_representations_get_the_same_panoramas(
    rooms: DictConfig, compared: dict[str, Any]
) -> None:
    stages = _stages(rooms, compared, representation__erp_height=200)
    for name in ("S-erp", "S-cubemap"):
        assert stages[name].config["representation"]["erp_height"] == 200
        assert stages[name].config["representation"]["level"] == 7
    assert "base_level" not in stages["S-erp"].config["representation"]


def test_the_study_has_a_stage_for_every_level(rooms: DictConfig) -> None:
    study: Any = {"study": "angular_resolution", "study_levels": [5, 7, 9]}
    stages = _stages(rooms, **study, representation__dim=60)
    assert [(s.name, s.level) for s in stages.values()] == [
        *(("P", None), ("S-level-5", 5), ("S-level-7", 7), ("S-level-9", 9))
    ]
    seen = [stage.config["representation"] for stage in stages.values()][1:]
    assert [r["level"] for r in seen] == [5, 7, 9]
    assert [r["erp_height"] for r in seen] == [64, 256, 256], "the files have 256 rows"
    assert [r["dim"] for r in seen] == [15, 60, 240]
    plain = _stages(rooms, representation__dim=60)
    assert stages["P"].config == plain["P"].config, "the same P as without a study"
    given = _stages(rooms, **study, checkpoint="/p.ckpt")
    assert list(given) == ["S-level-5", "S-level-7", "S-level-9"]
    assert {stage.weights for stage in given.values()} == {Path("/p.ckpt")}


def test_folds_and_seeds_one_after_the_other(rooms: DictConfig) -> None:
    config = rooms.copy()
    config.folds, config.seeds = [1, 3], [0, 5]
    found = [(s.fold, s.seed) for s in plan(config, FOLDER, {}) if s.name == "P"]
    assert found == [(1, 0), (1, 5), (3, 0), (3, 5)]


def test_data_without_folds() -> None:
    config = composed("transfer", "experiment=paper/transfer_omnisynthia_s6")
    stage = _stages(config)["P"]
    assert (stage.fold, stage.folder) == (None, FOLDER / "seed_0" / "P")
    assert "fold" not in stage.config["data"]
    with pytest.raises(SettingError, match=r"folds: found \[1\]; expected null"):
        _stages(config, folds=[1])


@pytest.mark.parametrize(
    ("setting", "value"),
    [
        ("fine_tuning.epochs", 3),
        ("fine_tuning.epochs", [0]),
        ("fine_tuning.epochs", [1, 1]),
        ("folds", [1.5]),
        ("seeds", [-1]),
        ("study", "everything"),
    ],
)
def test_impossible_settings(rooms: DictConfig, setting: str, value: Any) -> None:
    changes: dict[str, Any] = {setting.replace(".", "__"): value}
    with pytest.raises(SettingError, match=rf"^{setting}: found"):
        _stages(rooms, **changes)
