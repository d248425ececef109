from __future__ import annotations

import re
from pathlib import Path

import pytest
import torch
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from tangent_train.cli.compose import check_overrides, config_folder
from tangent_train.cli.stored import stored_run
from tangent_train.errors import DataError, SettingError


@pytest.mark.parametrize("group", ["representation", "optimizer", "scheduler", "network", "data"])
def test_every_option_of_every_group_composes(group: str) -> None:
    for path in (config_folder() / group).glob("*.yaml"):
        with initialize_config_dir(str(config_folder()), version_base="1.3"):
            config = compose("train", [f"{group}={path.stem}"])
        OmegaConf.resolve(config)


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("trainer.max_epoch=3", "Did you mean trainer.max_epochs"),
        ("experiment=rooms/demmo", "Did you mean rooms/demo"),
        ("expriment=rooms/demo", "Did you mean experiment"),
        ("data=synthroom", "Did you mean synthrooms"),
        ("representation=erp,erb_crops", "found 'erb_crops'"),
        ("nonsense", "override 'nonsense'"),
        ("experiment=null", "unknown experiment"),
        ("xyz=1", "(+xyz=… adds a setting"),
    ],
)
def test_misspelt_overrides_are_refused_with_the_near_matches(override: str, message: str) -> None:
    with pytest.raises(SettingError, match=re.escape(message)):
        check_overrides("train", [override])


@pytest.mark.parametrize(
    "arguments",
    [
        ["experiment=rooms/demo", "data.rooms.height=64", "network.widths=[4,8]"],
        ["-m", "optimizer.lr=1e-3,1e-2", "representation=erp,tangent"],
        ["+trainer.max_time=00:00:01:00", "hydra.run.dir=x", "~scheduler"],
        ["representation=erp", "representation.crop_deg=45"],
    ],
)
def test_good_overrides_pass(arguments: list[str]) -> None:
    check_overrides("train", arguments)


@pytest.mark.parametrize(
    ("command", "overrides", "message"),
    [
        ("train", ["experiment=rooms/transfer"], "an experiment of tangent-transfer"),
        ("prepare", ["experiment=paper/transfer_omnisynthia_s7"], "of tangent-transfer"),
        ("transfer", ["-m", "seed=0,1"], "-m: found a sweep; expected folds="),
        ("transfer", ["launcher=local"], "Could not override 'launcher'"),
        ("transfer", ["data@photos.data=synthroms"], "Did you mean synthrooms"),
        ("transfer", ["photos.data.photos_per_stp=4"], "Did you mean photos.data.photos_per_step"),
    ],
)
def test_what_another_command_understands_is_refused(
    command: str, overrides: list[str], message: str
) -> None:
    with pytest.raises(SettingError, match=re.escape(message)):
        check_overrides(command, overrides)


def test_an_experiment_of_a_user_that_only_sets_photos_is_one_of_transfer(tmp_path: Path) -> None:
    (tmp_path / "experiment").mkdir()
    (tmp_path / "experiment" / "mine.yaml").write_text(
        "# @package _global_\nphotos: {data: {photos_per_step: 2}}\n"
    )
    mine = ["experiment=mine", "--config-dir", str(tmp_path)]
    check_overrides("transfer", mine)
    with pytest.raises(SettingError, match="Run: tangent-transfer experiment=mine"):
        check_overrides("train", mine)


@pytest.mark.parametrize(
    "arguments",
    [
        ["experiment=rooms/transfer", "seeds=[0,1]", "photos.representation.fov_deg=60"],
        ["data@photos.data=stanford2d3ds_perspective", "scheduler@fine_tuning.scheduler=step"],
        ["experiment=rooms/demo", "photos.data.photos_per_step=4"],
    ],
)
def test_good_overrides_of_a_transfer_pass(arguments: list[str]) -> None:
    check_overrides("transfer", arguments)


def test_options_of_a_users_own_config_folder_are_known(tmp_path: Path) -> None:
    (tmp_path / "network").mkdir()
    (tmp_path / "network" / "mine.yaml").write_text("_target_: my.Network\nsize: 3\n")
    own = ["--config-dir", str(tmp_path)]
    check_overrides("train", ["network=mine", "network.size=4", *own])
    with pytest.raises(SettingError, match=r"Did you mean network\.size"):
        check_overrides("train", ["network=mine", "network.sizes=4", *own])


@pytest.mark.parametrize(
    ("command", "arguments"),
    [
        ("train", ["level=6"]),
        ("train", ["resume=null"]),
        ("train", ["checkpoint=x.ckpt"]),
        ("evaluate", []),
        ("evaluate", ["checkpoint="]),
        ("prepare", ["checkpoint=x.ckpt"]),
    ],
)
def test_a_command_without_a_stored_run_starts_from_the_users_configs(
    command: str, arguments: list[str]
) -> None:
    assert stored_run(command, arguments) is None


def test_resume_needs_a_run_that_has_begun(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="the folder of a run that has begun"):
        stored_run("train", [f"resume={tmp_path}"])


def _missing(path: Path) -> None:
    del path


def _garbage(path: Path) -> None:
    path.write_bytes(b"not a checkpoint")


def _foreign(path: Path) -> None:
    torch.save({"weights": torch.zeros(2)}, path)


def _pickle(path: Path) -> None:
    torch.save({"config": {}, "state_dict": {}, "extra": Path("x")}, path)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (_missing, "no such file"),
        (_garbage, "an unreadable file"),
        (_foreign, "no config inside"),
        (_pickle, "an unreadable file"),
    ],
)
def test_what_is_no_checkpoint_is_refused(tmp_path: Path, make: object, message: str) -> None:
    path = tmp_path / "x.ckpt"
    make(path)  # type: ignore[operator]
    with pytest.raises(DataError, match=message):
        stored_run("evaluate", [f"checkpoint={path}"])
