"""Settings of the commands: defaults, validation, comments, and every config of the tree."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import yaml  # type: ignore[import-untyped]
from omegaconf import OmegaConf

from tangent_train.config.help import annotate, command_settings, description, read_settings
from tangent_train.config.settings import SETTINGS
from tangent_train.errors import SettingError
from tangent_train.files import config_folder
from tests.cli.tiny_runs import run_command
from tests.running import Capture, Patch, command_of, composed, composed_settings, run_python

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
    "render": ["output=x"],
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
        ("train", ["level=20"], r"^level: found 20; .*less than or equal to 14"),
        ("predict", [*GIVEN["predict"], "levels=[9,20]"], "^levels: found 20; .*equal to 14"),
        ("predict", [*GIVEN["predict"], "mask=no.png"], "^mask: found no.png; .*existing file"),
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
    assert composed_settings("predict", *GIVEN["predict"], "mask=-60").mask == (-60,)


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


def unexplained(text: str) -> list[str]:
    """Lines of the settings in a help text without a comment beside or below them."""
    joined = re.sub(r"\n {32}# ", " # ", text)
    for _ in range(text.count("\n")):  # of long values
        joined = re.sub(r"^( *\w+: [\[{][^#\n]*[^#\n\]}])\n +", r"\1 ", joined, flags=re.MULTILINE)
    lines = [line for line in joined.splitlines()[1:] if line and not line.startswith("# ---")]
    return [line for line in lines if " # " not in line]


def by_heading(command: str) -> dict[str, list[str]]:
    """Names of settings in a help text by the heading above them."""
    parts = re.split("^# --- (.*) ---$", explained(command), flags=re.MULTILINE)[1:]
    names = [re.findall(r"^(\w+):", text, re.MULTILINE) for text in parts[1::2]]
    return dict(zip(parts[::2], names, strict=True))


@pytest.mark.parametrize("command", SETTINGS)
def test_help_explains_every_line_in_100_columns(
    command: str, monkeypatch: Patch, capsys: Capture
) -> None:
    run_command(monkeypatch, command, "--help")
    lines = capsys.readouterr().out.splitlines()
    assert [line for line in lines if len(line) > 100] == []
    template = (CONFIGS / f"{command}.yaml").read_text("utf-8").splitlines()
    examples = [line[6:] for line in template if line.startswith(f"{' ' * 8}tangent-")]
    assert examples == [line for line in lines if line.startswith("  tangent-")]
    assert unexplained(explained(command)) == []


@pytest.mark.parametrize("command", SETTINGS)
def test_help_prints_all_settings_under_headings_the_required_ones_first(command: str) -> None:
    config = OmegaConf.to_container(composed(command))
    assert yaml.safe_load(explained(command).partition("\n")[2]) == config
    headings = by_heading(command)
    required = {
        name
        for name, field in SETTINGS[command].model_fields.items()
        if field.is_required() and not (CONFIGS / name).is_dir()
    } - {"photos", "fine_tuning"}
    assert set(headings.get("required", ())) == required
    assert not required or next(iter(headings)) == "required"
    assert "other" not in headings
    assert sum(map(len, headings.values())) == len(config)


def test_headings_of_help_are_those_of_the_settings() -> None:
    found = by_heading("predict")
    assert [*found] == [
        *("required", "network", "input", "classes", "views", "output", "performance")
    ]
    assert found["required"] == ["checkpoint", "input", "output"]
    assert "rotations" in found["views"]
    assert "write" in found["output"]
    assert "device" in found["performance"]
    assert by_heading("evaluate")["classes"] == ["label_map", "unmapped", "prompts", "threshold"]
    assert by_heading("train")["views"] == ["level", "representation"]


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
        ("train", "resume=nowhere", "nowhere: found no config.yaml"),
        ("report", "--help", "runs/paper/semseg_s7_b0_rgbd --output"),
        ("train", "", "Missing: data= or experiment="),
        ("evaluate", "data=synthrooms", "checkpoint: found null; expected a network, or"),
        ("check", "data=folder data.root=no", "data.root: found no, no such folder"),
        ("evaluate", "checkpoint=. data=synthrooms label_map=no.json", "label_map: found no.json"),
        ("check", "data=synthrooms values=ids", "values: found ids; expected null: nothing reads"),
    ],
)
def test_answers_before_anything_heavy_is_imported(
    command: str, argument: str, message: str, tmp_path: Path
) -> None:
    code = (
        f"import sys; from tangent_train.cli.main import {command}\n"
        f"sys.argv = ['tangent-{command}', *'{argument}'.split()]\n"
        f"try:\n    {command}()\n"
        "finally:\n    heavy = {'torch', 'lightning', 'cv2', 'numba'} & set(sys.modules)\n"
        "    print('heavy', len(heavy))"
    )
    done = run_python(tmp_path, "-c", code)
    assert message in done.stdout + done.stderr
    assert "heavy 0" in done.stdout
