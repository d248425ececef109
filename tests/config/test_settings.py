"""Settings of the commands: defaults, validation, comments, and every config of the tree."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from tangent_train.config.help import annotate, command_settings, description, read_settings
from tangent_train.config.settings import SETTINGS
from tangent_train.errors import SettingError
from tangent_train.files import config_folder
from tests.running import command_of, composed, composed_settings, run_python

CONFIGS = config_folder()
EXPERIMENTS = sorted(
    path.relative_to(CONFIGS / "experiment").with_suffix("").as_posix()
    for path in (CONFIGS / "experiment").rglob("*.yaml")
)
GROUPS = (
    "data",
    "network",
    "optimizer",
    "recipe",
    "representation",
    "scheduler",
    "task",
    "trainer",
)
GIVEN = {
    "evaluate": [f"checkpoint={CONFIGS}"],
    "export": [f"checkpoint={CONFIGS}", "output=x"],
    "import": ["library=onnx", "output=x"],
    "keypoints": ["output=x"],
    "predict": [f"checkpoint={CONFIGS}", "input=x", "output=x"],
}
"""Settings that must be given, with an existing folder for paths."""


@pytest.mark.parametrize("command", SETTINGS)
def test_the_defaults_of_every_command_are_valid(command: str) -> None:
    settings = composed_settings(command, *GIVEN.get(command, ()))
    assert isinstance(settings, SETTINGS[command])


@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_every_experiment_is_valid(experiment: str) -> None:
    settings = composed_settings(command_of(experiment), f"experiment={experiment}")
    assert settings.name in (experiment, experiment.removeprefix("rooms/"))


@pytest.mark.parametrize("group", GROUPS)
def test_every_option_of_every_group_composes(group: str) -> None:
    for path in (CONFIGS / group).glob("*.yaml"):
        OmegaConf.resolve(composed("train", f"{group}={path.stem}"))


@pytest.mark.parametrize("task", ["classification", "depth", "segmentation"])
def test_a_recipe_sets_what_the_task_has(task: str) -> None:
    for command in ("train", "transfer"):
        settings = composed_settings(command, f"task={task}", "recipe=small")
        assert settings.task["channels_last"]
        assert settings.level == 6


@pytest.mark.parametrize(
    ("command", "overrides", "message"),
    [
        ("train", ["seed=abc"], r"^seed: found abc; expected a valid integer"),
        ("train", ["+sed=1"], r"^sed: found 1; expected a known setting\. Did you mean seed\?"),
        ("export", ["checkpoint=none.ckpt", "output=x"], r"^checkpoint: found none\.ckpt; .*exist"),
        ("export", [f"checkpoint={CONFIGS}"], "^Missing: output=. Example: tangent-export checkp"),
        ("train", ["level=20"], r"^level: found 20; .*less than or equal to 14"),
        ("predict", [*GIVEN["predict"], "levels=[9,20]"], "^levels: found 20; .*equal to 14"),
        ("keypoints", ["output=x", "pairing=some"], "^pairing: .*'consecutive' or 'all'"),
        ("keypoints", ["output=x", "base_level=[a]"], r"^base_level: found a; .*integer"),
        (
            "predict",
            [*GIVEN["predict"], "mask=no.png"],
            "^mask: found no.png; .*an existing file",
        ),
        ("transfer", ["fine_tuning.optimizer.lr=x"], r"^fine_tuning\.optimizer\.lr: found x; "),
    ],
)
def test_invalid_settings_are_named(command: str, overrides: list[str], message: str) -> None:
    with pytest.raises(SettingError, match=message):
        composed_settings(command, *overrides)


def test_a_single_value_is_a_list_and_paths_are_paths() -> None:
    settings = composed_settings("keypoints", "output=a b", "base_level=1")
    assert settings.base_level == (1,)
    assert settings.output == Path("a b")
    assert composed_settings("predict", *GIVEN["predict"], "mask=-60").mask == -60


@pytest.mark.parametrize("path", sorted(CONFIGS.glob("*/*.yaml")), ids=lambda path: path.stem)
def test_every_setting_of_an_option_has_a_comment(path: Path) -> None:
    assert description(path)
    if path.parent.name not in ("experiment", "recipe"):  # which set what is explained elsewhere
        assert not [
            one.name
            for one in read_settings(path)
            if one.value and not one.comment and not one.name.endswith(("_target_", "_partial_"))
        ]


@pytest.mark.parametrize("command", SETTINGS)
def test_every_setting_of_a_command_has_a_comment(command: str) -> None:
    assert [one.name for one in command_settings(command) if not one.comment] == []


def explained(command: str, *overrides: str) -> str:
    return annotate("== Settings ==\n" + OmegaConf.to_yaml(composed(command, *overrides)), command)


@pytest.mark.parametrize("command", ["check", "predict", "train", "transfer"])
def test_help_explains_every_line(command: str) -> None:
    assert [line for line in explained(command).splitlines()[1:] if " # " not in line] == []


def test_settings_of_one_name_are_explained_apart() -> None:
    text = explained("transfer", "data@photos.data=folder_photos")
    sides = re.findall(r"dim: null +# (side of .*);", text)
    assert {side.partition(",")[0] for side in sides} == {
        "side of the images in pixels",
        "side of a crop in pixels",
    }
    assert re.search(r"^    root: data/photos +# folder with classes.json", text, re.MULTILINE)
    assert re.search(r"^  inputs: \[rgb, depth\] +# ", explained("train"), re.MULTILINE)


@pytest.mark.parametrize(
    ("command", "argument", "message"),
    [
        ("train", "--help", "backbone_lr_factor: 1.0       # factor of the learning rate"),
        ("train", "levl=5", "Did you mean level?"),
        ("train", "resume=nowhere", "nowhere: found no config.yaml"),
        ("export", "output=x.onnx", "tangent-export: Missing: checkpoint=. Example: "),
        ("report", "--help", "runs/paper/semseg_s7_b0_rgbd --output"),
    ],
)
def test_answers_before_anything_heavy_is_imported(
    command: str, argument: str, message: str, tmp_path: Path
) -> None:
    code = (
        f"import sys; from tangent_train.cli.main import {command}\n"
        f"sys.argv = ['tangent-{command}', '{argument}']\n"
        f"try:\n    {command}()\n"
        "finally:\n    heavy = {'torch', 'lightning', 'cv2', 'numba'} & set(sys.modules)\n"
        "    print('heavy', len(heavy))"
    )
    done = run_python(tmp_path, "-c", code)
    assert message in done.stdout + done.stderr
    assert "heavy 0" in done.stdout
