"""``--help``: the comments of the config files explain every setting."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from tangent_train.cli.help import annotate, description, read_settings
from tangent_train.files import config_folder
from tests.running import composed

CONFIGS = config_folder()
COMMANDS = sorted(CONFIGS.glob("*.yaml"))
OPTIONS = sorted(CONFIGS.glob("*/*.yaml"))
HEADING = "== Settings ==\n"


@pytest.mark.parametrize("path", [*COMMANDS, *OPTIONS], ids=lambda path: path.stem)
def test_every_setting_of_a_config_file_has_a_comment(path: Path) -> None:
    assert description(path)
    if path.parent.name in ("experiment", "recipe"):
        return  # they choose values of settings that are explained elsewhere
    unexplained = [
        setting.name
        for setting in read_settings(path)
        if setting.value
        and not setting.comment
        and not setting.name.endswith(("_target_", "_partial_"))
        and not (path in COMMANDS and setting.name.startswith("hydra."))
    ]
    assert unexplained == []


def explained(command: str, *overrides: str) -> str:
    config = OmegaConf.to_yaml(composed(command, *overrides))
    return annotate(HEADING + config, CONFIGS, command)


@pytest.mark.parametrize("command", ["check", "predict", "train", "transfer"])
def test_help_explains_every_line(command: str) -> None:
    lines = explained(command).splitlines()
    assert [line for line in lines[1:] if " # " not in line] == []


def test_settings_of_one_name_are_explained_apart() -> None:
    text = explained("transfer", "data@photos.data=folder_photos")
    sides = re.findall(r"dim: null +# (side of .*);", text)
    assert [side.partition(",")[0] for side in sides] == [
        "side of the images in pixels",
        "side of a crop in pixels",
    ]
    assert re.search(r"^    root: data/photos +# folder with classes.json", text, re.MULTILINE)


def test_lists_are_printed_on_one_line() -> None:
    assert re.search(r"^  inputs: \[rgb, depth\] +# ", explained("train"), re.MULTILINE)
