"""What a transfer is to run: its stages and their configs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from hydra import compose, initialize_config_dir
from omegaconf import DictConfig, OmegaConf

from tangent_train.cli.compose import compose_option, config_folder
from tangent_train.cli.transfer.configs import StageConfigs
from tangent_train.cli.transfer.stages import Stage, folds_and_seeds, plan
from tangent_train.errors import SettingError

FOLDER = Path("/runs/mine")


def _composed(*overrides: str, name: str = "transfer") -> DictConfig:
    with initialize_config_dir(str(config_folder()), version_base="1.3"):
        return compose(name, list(overrides))


@pytest.fixture(scope="module")
def rooms() -> DictConfig:
    """With the figures below, however the experiment is tuned."""
    fixed = ("level=7", "data.rooms.height=256", "fine_tuning.epochs=[1,10]", "folds=null")
    rates = ("optimizer=adamw", "optimizer.lr=3e-3", "scheduler@fine_tuning.scheduler=constant")
    epochs = ("scheduler=one_cycle", "trainer.max_epochs=20")
    return _composed("experiment=rooms/transfer", *fixed, *rates, *epochs)


@pytest.fixture(scope="module")
def compared() -> dict[str, dict[str, Any]]:
    with initialize_config_dir(str(config_folder()), version_base="1.3"):
        return {name: compose_option("representation", name) for name in ("erp", "cubemap")}


def _stages(config: DictConfig, compared: Any = (), fold: int | None = 1) -> dict[str, Stage]:
    return {stage.name: stage for stage in plan(config, FOLDER, fold, 3, dict(compared))}


def _resolved(stage: Stage) -> dict[str, Any]:
    config: Any = OmegaConf.to_container(OmegaConf.create(stage.config), resolve=True)
    return dict(config)


def _with(config: DictConfig, **settings: Any) -> DictConfig:
    changed = config.copy()
    for name, value in settings.items():
        OmegaConf.update(changed, name.replace("__", "."), value, force_add=True)
    return changed


def test_the_stages_in_their_order(rooms: DictConfig, compared: dict[str, Any]) -> None:
    stages = plan(rooms, FOLDER, 2, 3, compared)
    folder = FOLDER / "fold_2" / "seed_3"
    assert [
        (s.name, s.on, s.epochs, s.representation, s.command, s.weights and s.weights.name)
        for s in stages
    ] == [
        ("P", "photos", 0, "perspective", "train", None),
        ("S", "panoramas", 0, "tangent", "evaluate", "P"),
        ("S-erp", "panoramas", 0, "erp", "evaluate", "P"),
        ("S-cubemap", "panoramas", 0, "cubemap", "evaluate", "P"),
        ("P-FT-1", "photos", 1, "perspective", "train", "P"),
        ("S-FT-1", "panoramas", 1, "tangent", "train", "P"),
        ("P-FT-10", "photos", 10, "perspective", "train", "P"),
        ("S-FT-10", "panoramas", 10, "tangent", "train", "P"),
    ]
    assert all(stage.folder == folder / stage.name for stage in stages)
    assert all((stage.fold, stage.seed) == (2, 3) for stage in stages)


def test_a_stages_config_is_one_of_tangent_train(
    rooms: DictConfig, compared: dict[str, Any]
) -> None:
    ordinary = set(_composed(name="train")) - {"sweep", "launcher"}
    for stage in _stages(rooms, compared).values():
        assert set(stage.config) == ordinary
        resolved = _resolved(stage)
        assert resolved["seed"] == resolved["data"]["seed"] == 3
        assert resolved["name"] == f"rooms/transfer/{stage.name}"


def test_photos_are_seen_by_the_stages_on_photos_only(rooms: DictConfig) -> None:
    for stage in _stages(rooms, fold=2).values():
        config = _resolved(stage)
        photos = stage.on == "photos"
        assert config["data"]["_target_"].endswith("Perspective") == photos
        assert ("photos_per_step" in config["data"]) == photos
        assert config["representation"]["_target_"].endswith("PerspectiveRepresentation") == photos
        assert config["data"]["fold"] == 2
        assert config["data"]["root"] == "data/rooms_transfer"
        assert config["data"]["rooms"]["views"] == rooms.data.rooms.views


def test_level_and_seed_of_a_checkpoint_reach_what_refers_to_them(
    rooms: DictConfig, compared: dict[str, Any]
) -> None:
    for stage in _stages(rooms, compared).values():
        later = {**stage.config, "level": 9, "seed": 11}
        config: Any = OmegaConf.to_container(OmegaConf.create(later), resolve=True)
        assert config["representation"]["level"] == 9
        assert config["data"]["seed"] == 11


def test_fine_tuning_takes_a_tenth_of_the_rate(rooms: DictConfig) -> None:
    config = _with(rooms, fine_tuning__scheduler={"max_lr": "${optimizer.lr}"})
    stages = _stages(config)
    tuned = _resolved(stages["S-FT-10"])
    assert tuned["optimizer"]["lr"] == 3e-4
    assert tuned["optimizer"]["weight_decay"] == rooms.optimizer.weight_decay
    assert tuned["scheduler"]["max_lr"] == 3e-4, "of fine-tuning, not of P"
    assert tuned["scheduler"]["_target_"].endswith("ConstantLR")
    assert tuned["trainer"]["max_epochs"] == 10
    first = _resolved(stages["P"])
    assert (first["optimizer"]["lr"], first["trainer"]["max_epochs"]) == (3e-3, 20)
    assert first["scheduler"]["_target_"].endswith("OneCycleLR")


def test_fine_tuning_with_an_optimizer_of_its_own(rooms: DictConfig) -> None:
    own = {"_target_": "torch.optim.SGD", "_partial_": True, "lr": "${optimizer.lr}"}
    tuned = _resolved(_stages(_with(rooms, fine_tuning__optimizer=own))["P-FT-1"])
    assert tuned["optimizer"] == {**own, "lr": 3e-3}, "AdamW's settings are not SGD's"


def test_a_rate_that_is_not_there_has_no_tenth(rooms: DictConfig) -> None:
    with pytest.raises(SettingError, match=r"fine_tuning\.optimizer\.lr: found null, a tenth"):
        _stages(_with(rooms, optimizer__lr=None))


def test_other_ways_to_see_panoramas_get_the_same_panoramas(
    rooms: DictConfig, compared: dict[str, Any]
) -> None:
    stages = _stages(_with(rooms, representation__erp_height=200), compared)
    assert _resolved(stages["S-erp"])["representation"]["erp_height"] == 200
    assert _resolved(stages["S-cubemap"])["representation"]["erp_height"] == 200
    assert "base_level" not in stages["S-erp"].config["representation"]


def test_the_study_has_a_stage_for_every_level(rooms: DictConfig) -> None:
    study = _with(rooms, study="angular_resolution", study_levels=[5, 7, 9])
    stages = _stages(study)
    assert list(stages) == ["P", "S-level-5", "S-level-7", "S-level-9"]
    assert [stage.level for stage in stages.values()] == [None, 5, 7, 9]
    seen = [_resolved(stage)["representation"] for stage in stages.values()][1:]
    assert [r["level"] for r in seen] == [5, 7, 9]
    assert [r["erp_height"] for r in seen] == [64, 256, 256], "the files have 256 rows"
    assert stages["P"].config == _stages(rooms)["P"].config, "the same P as without a study"


def test_the_study_scales_a_side_in_pixels(rooms: DictConfig) -> None:
    study = _with(rooms, study="angular_resolution", study_levels=[6, 8], representation__dim=60)
    seen = [s.config["representation"]["dim"] for s in list(_stages(study).values())[1:]]
    assert seen == [30, 120]


def test_a_given_network_is_only_evaluated(rooms: DictConfig, tmp_path: Path) -> None:
    given = _with(rooms, checkpoint=str(tmp_path / "p.ckpt"))
    stages = _stages(given)
    assert stages["P"].command == "evaluate"
    assert {stage.weights for stage in stages.values()} == {tmp_path / "p.ckpt"}
    study = _stages(_with(given, study="angular_resolution", study_levels=[7]))
    assert list(study) == ["S-level-7"]


def test_folds_and_seeds_one_after_the_other(rooms: DictConfig) -> None:
    several = _with(rooms, folds=[1, 3], seeds=[0, 5])
    assert folds_and_seeds(several) == [(1, 0), (1, 5), (3, 0), (3, 5)]
    assert folds_and_seeds(_with(rooms, data__fold=2, seed=4)) == [(2, 4)]


def test_data_without_folds() -> None:
    config = _composed("experiment=paper/transfer_omnisynthia_s6")
    assert folds_and_seeds(config) == [(None, 0)]
    stages = _stages(config, fold=None)
    assert stages["P"].folder == FOLDER / "seed_3" / "P"
    assert "fold" not in _resolved(stages["P"])["data"]
    with pytest.raises(SettingError, match=r"folds: found \[1\]; expected null"):
        folds_and_seeds(_with(config, folds=[1]))


@pytest.mark.parametrize(
    ("setting", "value"),
    [
        ("fine_tuning.epochs", 3),
        ("fine_tuning.epochs", [0]),
        ("fine_tuning.epochs", [1, 1]),
        ("fine_tuning.epochs", [True]),
        ("folds", [1.5]),
        ("seeds", ["a"]),
        ("seeds", [-1]),
        ("study", "everything"),
        ("study_levels", "5-8"),
    ],
)
def test_impossible_settings(rooms: DictConfig, setting: str, value: Any) -> None:
    study = {"study": "angular_resolution"} if setting == "study_levels" else {}
    config = _with(rooms, **study, **{setting.replace(".", "__"): value})
    with pytest.raises(SettingError, match=rf"^{setting}: found"):
        [plan(config, FOLDER, *pair, {}) for pair in folds_and_seeds(config)]


def test_references_between_sections() -> None:
    config = OmegaConf.create(
        {
            "seed": 1,
            "level": 5,
            "study_max_rows": None,
            "data": {"root": "sphere", "size": {"rows": 4}},
            "representation": {"level": "${level}", "erp_height": "${data.size.rows}"},
            "optimizer": {"lr": 1.0},
            "trainer": {"max_epochs": 1, "devices": "${photos.extra}"},
            "photos": {
                "extra": 2,
                "data": {
                    "root": "${data.root}/photos",
                    "size": "${data.size}",
                    "again": "${.root}",
                    "outside": "${..extra}",
                    "list": ["${seed}", "${data.root}", "x"],
                    "env": "${oc.env:NOWHERE,default}",
                    "both": "${seed}-${data.root}",
                },
                "representation": {"level": "${level}", "rows": "${representation.erp_height}"},
            },
            "fine_tuning": {"optimizer": {"lr": None}, "scheduler": {"lr": "${optimizer.lr}"}},
        }
    )
    configs = StageConfigs(config, None, 8)
    photos = configs.on_photos()
    assert photos["data"] == {
        "root": "sphere/photos",
        "size": {"rows": 4},
        "again": "${.root}",
        "outside": 2,
        "list": ["${seed}", "sphere", "x"],
        "env": "${oc.env:NOWHERE,default}",
        "both": "8-sphere",
    }
    assert photos["representation"] == {"level": "${level}", "rows": 4}
    assert photos["trainer"]["devices"] == 2
    assert configs.on_panoramas()["representation"]["erp_height"] == "${data.size.rows}"
    assert configs.fine_tuned(photos, 4, seen=False)["scheduler"] == {"lr": "${optimizer.lr}"}


def test_fine_tuning_on_photos_draws_other_crops_than_training_did(
    rooms: DictConfig, compared: dict[str, Any]
) -> None:
    streams = {
        stage.name: stage.config["data"].get("stream", 0)
        for stage in plan(rooms, Path("folder"), 1, 0, compared)
    }
    assert {name for name, stream in streams.items() if stream} == {"P-FT-1", "P-FT-10"}
