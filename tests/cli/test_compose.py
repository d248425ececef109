"""Every option of the config tree, composed once; where a command starts from a checkpoint."""

from __future__ import annotations

from pathlib import Path

import pytest
from omegaconf import OmegaConf

from tangent_train.cli.compose import config_folder
from tangent_train.cli.stored import stored_run
from tangent_train.errors import DataError
from tests.running import composed

GROUPS = ("representation", "optimizer", "scheduler", "network", "data", "trainer", "task")


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
