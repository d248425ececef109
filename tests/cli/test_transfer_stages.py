"""The stages of a transfer and their configs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hydra import initialize_config_dir
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from tangent_train.cli.transfer_stages import Stage, plan
from tangent_train.cli.transfer_views import views_of
from tangent_train.config.build import build_from_config
from tangent_train.errors import SettingError
from tangent_train.files import config_folder
from tangent_train.inference.representations import check_size
from tests.inference.trained import trained_network
from tests.running import composed

FOLDER = Path("/runs/mine")


@pytest.fixture(scope="module")
def rooms() -> DictConfig:
    """With the settings below, however the experiment is tuned."""
    fixed = ("level=7", "data.rooms.height=256", "fine_tuning.epochs=[1,10]", "seed=3")
    rates = ("optimizer=adamw", "optimizer.lr=3e-3", "scheduler@fine_tuning.scheduler=constant")
    epochs = ("scheduler=one_cycle", "trainer.max_epochs=20")
    return composed("transfer", "experiment=rooms/transfer", *fixed, *rates, *epochs)


@pytest.fixture(autouse=True, scope="module")
def _hydra() -> Any:
    """Set Hydra's config to that of a command with the default options."""
    HydraConfig.instance().set_config(composed("transfer", return_hydra_config=True))


def _stages(config: DictConfig, trained: Any = None, **settings: Any) -> dict[str, Stage]:
    config = config.copy()
    for name, value in settings.items():
        OmegaConf.update(config, name.replace("__", "."), value, force_add=True)
    with initialize_config_dir(str(config_folder()), version_base="1.3"):
        views = views_of(config, trained)
    return {stage.name: stage for stage in plan(config, FOLDER, views)}


def test_the_stages_in_their_order(rooms: DictConfig) -> None:
    stages = _stages(rooms, folds=[2]).values()
    assert [(s.name, s.command, s.weights and s.weights.parts[-3]) for s in stages] == [
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
    ordinary = set(composed("train"))
    for stage in stages:
        config, photos = stage.config, stage.name[0] == "P"
        assert set(config) == ordinary
        assert (config["seed"], config["data"]["seed"], config["data"]["fold"]) == (3, 3, 2)
        assert config["name"] == f"rooms/transfer/{stage.name}"
        assert config["data"]["_target_"].endswith("Perspective") == photos
        assert config["representation"]["_target_"].endswith("PerspectiveRepresentation") == photos
        assert config["data"]["root"] == "data/rooms_transfer"
        assert config["data"].get("sampling_seed", 0) == ("P-FT" in stage.name), "other crops"


def test_fine_tuning_takes_a_tenth_of_the_rate(rooms: DictConfig) -> None:
    stages = _stages(rooms, fine_tuning__scheduler={"max_lr": "${optimizer.lr}"})
    tuned, first = stages["S-FT-10"].config, stages["P"].config
    assert tuned["optimizer"] == {**first["optimizer"], "lr": 3e-4}
    assert tuned["scheduler"]["max_lr"] == 3e-4, "of fine-tuning, not of P"
    assert tuned["scheduler"]["_target_"].endswith("ConstantLR")
    assert tuned["trainer"]["max_epochs"] == 10
    assert (first["optimizer"]["lr"], first["trainer"]["max_epochs"]) == (3e-3, 20)
    assert first["scheduler"]["_target_"].endswith("OneCycleLR")
    with pytest.raises(SettingError, match=r"fine_tuning\.optimizer\.lr: found null \(a tenth"):
        _stages(rooms, optimizer__lr=None)


def _seen(stages: dict[str, Stage], name: str, *settings: str) -> list[Any]:
    section = stages[name].config["representation"]
    return [section["_target_"].rpartition(".")[2][:4], *(section.get(n) for n in settings)]


def test_all_views_see_the_same_panoramas(rooms: DictConfig) -> None:
    views: Any = [
        "erp",
        {"name": "fine", "option": "erp", "rows": 400},
        {"name": "cube", "option": "cubemap", "dim": "${level}"},
        "horizontal_economy",
        {"name": "wide", "level": 6, "base_level": 0, "blend": "feather"},
    ]
    stages = _stages(rooms, compare=views, representation__erp_height=200)
    assert _seen(stages, "S-erp", "level", "rows", "base_level") == ["Equi", 7, None, None]
    assert _seen(stages, "S-fine", "level", "rows") == ["Equi", 7, 400]
    assert _seen(stages, "S-cube", "level", "dim") == ["Cube", 7, 7]
    assert _seen(stages, "S-horizontal_economy", "level", "dim", "rotations") == [
        "Ring",
        7,
        None,
        1,
    ]
    assert _seen(stages, "S-wide", "level", "base_level", "blend") == ["Tang", 6, 0, "feather"]
    assert [stages[f"S-{name}"].config["level"] for name in ("fine", "wide")] == [7, 6]
    rows = {s.config["representation"].get("erp_height") for n, s in stages.items() if n[0] == "S"}
    assert rows == {200}
    coarse = _stages(rooms, compare=views, representation__dim=60)
    assert _seen(coarse, "S-wide", "dim", "erp_height") == ["Tang", 30, 256], "those of level 7"


def test_photos_are_needed_to_train_on_but_not_to_test_a_given_network() -> None:
    without = composed("transfer", "fine_tuning.epochs=[]", "compare=[]")
    with pytest.raises(SettingError, match=r"data@photos\.data: found none; .*checkpoint="):
        _stages(without)
    assert list(_stages(without, checkpoint="/p.ckpt")) == ["S"]


def test_the_plan_for_networks_of_photos(capsys: pytest.CaptureFixture[str]) -> None:
    config = composed("transfer", "experiment=zero_shot", "checkpoint=/net.onnx")
    tangent = {"_target_": "tangent_train.rendering.TangentRepresentation", "erp_height": 1024}
    size = {"base_level": 0, "level": 9, "dim": 512, "levels": [9, 8]}
    trained = trained_network(tangent | size, fixed_size=(512, 512), photo_level=10)
    stages = _stages(config, trained, representation=tangent | size)
    assert "View erp-512-distortion-aware is left out: " in capsys.readouterr().out
    assert len(stages) == len(config.compare) * len(config.conditions)
    for stage in stages.values():
        made = build_from_config(stage.config["representation"], "representation")
        assert made.erp_height == 1024
        check_size(trained, made.image_size)
    assert _seen(stages, "S", "level", "levels", "dim") == ["Tang", 9, [9, 8], 512]
    assert _seen(stages, "S-tangent-9-b0", "level", "levels") == ["Tang", 9, None]
    assert _seen(stages, "S-tangent-10-b1", "level", "dim") == ["Tang", 10, 512]
    flexible = replace(trained, fixed_size=None)
    all_stages = _stages(config, flexible, representation=tangent | size)
    section = all_stages["S-erp-512-distortion-aware"].config["representation"]
    assert (section["distortion_aware"], section["rows"]) == (True, 512)
    assert len(all_stages) - len(stages) == len(config.conditions)


def test_the_study_has_a_stage_for_every_level(rooms: DictConfig) -> None:
    study: Any = {"study_levels": [5, 7, 9]}
    stages = _stages(rooms, **study, representation__dim=60)
    assert [(s.name, s.view) for s in stages.values()] == [
        *(("P", ""), ("S-level-5", "level-5"), ("S-level-7", "level-7"), ("S-level-9", "level-9"))
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
        ("fine_tuning.epochs", [0]),
        ("folds", [1, 1]),
        ("seeds", 3),
        ("compare", "erp"),
        ("compare", ["erp", "erp"]),
        ("compare", ["../erp"]),
        ("conditions", []),
        ("conditions", [3]),
        ("label_map", "my_map.json"),
    ],
)
def test_impossible_settings_are_refused(rooms: DictConfig, setting: str, value: Any) -> None:
    changes: dict[str, Any] = {setting.replace(".", "__"): value}
    with pytest.raises(SettingError, match=rf"^{setting}: found"):
        _stages(rooms, **changes)
