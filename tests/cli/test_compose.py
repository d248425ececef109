"""Every config of the tree, composed once; where a command starts from a checkpoint."""

from __future__ import annotations

from pathlib import Path

import pytest
from omegaconf import OmegaConf

from tangent_train.cli.compose import config_folder
from tangent_train.cli.stored import stored_run
from tangent_train.errors import DataError
from tests.running import composed

EXPERIMENTS = sorted(
    path.relative_to(config_folder() / "experiment").with_suffix("").as_posix()
    for path in (config_folder() / "experiment").rglob("*.yaml")
)
GROUPS = ("representation", "optimizer", "scheduler", "network", "data", "trainer", "task")


@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_every_experiment_composes(experiment: str) -> None:
    command = "transfer" if Path(experiment).name.startswith("transfer") else "train"
    config = composed(command, f"experiment={experiment}")
    OmegaConf.resolve(config)
    assert config.name in (experiment, experiment.removeprefix("rooms/"))


@pytest.mark.parametrize("group", GROUPS)
def test_every_option_of_every_group_composes(group: str) -> None:
    for path in (config_folder() / group).glob("*.yaml"):
        OmegaConf.resolve(composed("train", f"{group}={path.stem}"))


def test_a_command_starts_from_a_stored_run_only_where_there_is_one(tmp_path: Path) -> None:
    for command, argument in (("train", "resume=null"), ("evaluate", "checkpoint="), ("check", "")):
        assert stored_run(command, [argument]) is None
    with pytest.raises(DataError, match="the folder of a started run"):
        stored_run("train", [f"resume={tmp_path}"])
    with pytest.raises(DataError, match=r"found a folder; .*checkpoints/best\.ckpt"):
        stored_run("evaluate", [f"checkpoint={tmp_path}"])
