"""Settings that nothing reads are refused by every command."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from omegaconf import OmegaConf

from tangent_train.checkpoints.content import read_settings
from tangent_train.cli.command_settings import SETTINGS
from tangent_train.cli.setting_names import check_names
from tangent_train.errors import SettingError
from tangent_train.files import config_folder
from tests.cli import tiny_runs
from tests.cli.tiny_runs import Run, results
from tests.running import command_of, composed

EXPERIMENTS = [
    path.relative_to(config_folder() / "experiment").with_suffix("").as_posix()
    for path in sorted((config_folder() / "experiment").rglob("*.yaml"))
]


def _check(command: str, *overrides: str) -> None:
    config: Any = OmegaConf.to_container(composed(command, *overrides))
    check_names(command, config, str(config))


@pytest.mark.parametrize("command", SETTINGS)
def test_all_settings_of_a_command_are_declared_and_others_are_not(command: str) -> None:
    _check(command)
    with pytest.raises(SettingError, match=r"^anything: found 1, which tangent-.* does not read"):
        _check(command, "+anything=1")


@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_experiments_set_what_is_read(experiment: str) -> None:
    _check(command_of(experiment), f"experiment={experiment}")


@pytest.mark.parametrize("group", ["debug", "callbacks", "logger", "sweep", "launcher", "recipe"])
def test_options_of_groups_set_what_is_read(group: str) -> None:
    for path in sorted((config_folder() / group).glob("*.yaml")):
        if (group, path.stem) not in {
            ("launcher", "local"),
            ("launcher", "slurm"),
            ("sweep", "optuna"),
        }:
            _check("train", f"{group}={path.stem}")


@pytest.mark.parametrize(
    ("command", "overrides", "message"),
    [
        ("train", ["+data_rooot=x"], r"^data_rooot: found x, .*\. Is data\.root meant\?"),
        ("train", ["+trainr={max_epochs: 3}"], r"^trainr: found .*\. Is trainer meant\?"),
        ("evaluate", ["+checkpont=x"], r"^checkpont: .*\. Is checkpoint meant\?"),
        ("predict", ["+ouput=x"], r"^ouput: .*\. Is output meant\?"),
        ("keypoints", ["+pairng=all"], r"^pairng: .*\. Is pairing meant\?"),
        ("import", ["+fov_deg=60"], r"^fov_deg: found 60, which tangent-import does not read"),
        ("transfer", ["+fine_tuning.epoch=[1]"], r"^fine_tuning\.epoch: .*g\.epochs meant"),
        ("transfer", ["+photos.foo=1"], r"^photos\.foo: found 1.*lists\. (?!Is photos meant)"),
        ("transfer", ["+photos.data.root=x"], r"^photos\.data\.root: found x"),
        ("transfer", ["+study.levels=[5]"], r"^study: .*"),
        ("train", ["experiment=zero_shot"], r"^fine_tuning: .*\. Is tangent-transfer meant\?"),
        ("train", ["+checkpoint=x"], r"^checkpoint: found x, which tangent-train does not read"),
    ],
)  # fmt: skip
def test_the_nearest_setting_is_named(command: str, overrides: list[str], message: str) -> None:
    with pytest.raises(SettingError, match=message):
        _check(command, *overrides)


@pytest.mark.parametrize(
    "reference",
    [
        "${mine}",
        "${mine.deep}",
        "${oc.select:mine,1}",
        "${..mine}",
        "runs/${ mine }/x",
        "${mine[0]}",
    ],
)
def test_settings_that_the_config_refers_to_are_read(reference: str) -> None:
    _check("train", "+mine={deep: 1}", f"name='{reference}'")
    with pytest.raises(SettingError, match=r"^mine: "):
        _check("train", "+mine=1", "name='${yours}'")
    with pytest.raises(SettingError, match=r"^mine: "):
        _check("train", "+mine=1", "name='${data.mine}'")


def test_sections_of_classes_are_their_own() -> None:
    _check(
        "transfer",
        "data@photos.data=folder_photos",
        "photos.data.root=x",
        "+photos.representation.anything=1",
        "+fine_tuning.optimizer.weight_decay=1e-2",
        "+data.anything=1",
        "+callbacks.mine={_target_: my.Callback}",
    )


OWN = """
# @package _global_
defaults: [/experiment/rooms/demo@_here_]
my_rate: 2e-3
folder: mine
optimizer: {lr: "${my_rate}"}
hydra: {run: {dir: "${folder}"}}
"""


def test_an_experiment_of_ones_own(rooms: str, tmp_path: Path, run: Run) -> None:
    """Its settings may refer to others of its own; a misspelled one stops before any work."""
    (tmp_path / "own" / "experiment").mkdir(parents=True)
    file = tmp_path / "own" / "experiment" / "mine.yaml"
    settings = [s for s in tiny_runs.SETTINGS if not s.startswith(("experiment=", "trainer.max_"))]
    line = ["--config-dir=own", "experiment=mine", *settings, rooms, "trainer.max_epochs=1"]
    file.write_text(f"{OWN}\ntrianer: {{max_epochs: 3}}\n")
    with pytest.raises(SystemExit, match=r"^tangent-train: trianer: .*Is trainer meant\?"):
        run("train", *line)
    assert not (tmp_path / "mine").exists()
    with pytest.raises(SystemExit, match=r"^tangent-train: trianer: .*Is trainer meant\?"):
        run("train", "-m", *line, "seed=0,1", "hydra.sweep.dir=swept")
    file.write_text(OWN)
    run("train", *line)
    kept = read_settings(tmp_path / "mine" / "config.yaml")
    assert kept["optimizer"]["lr"] == 2e-3
    assert not {"my_rate", "folder"} & kept.keys()
    assert results(tmp_path / "mine")["images"] == 2
    run("train", "resume=mine")


@pytest.mark.parametrize(
    ("command", "override"),
    [
        ("prepare", "+network.width=[8]"),
        ("check", "+trainer.max_epoch=3"),
        ("train", "+optimizer.foo=1"),
        ("prepare", "+data.rotation=so3"),
    ],
)
def test_arguments_that_a_class_does_not_take(
    command: str, override: str, rooms: str, run: Run
) -> None:
    """Also of sections that the command does not build."""
    section, _, name = override.strip("+").partition("=")[0].partition(".")
    message = rf"^tangent-{command}: {section}: found {name} for .*Remove it\.$"
    with pytest.raises(SystemExit, match=message):
        run(command, *tiny_runs.SETTINGS, rooms, override)


def test_overrides_on_both_sides_of_an_option(tmp_path: Path, run: Run) -> None:
    with pytest.raises(SystemExit, match=r"^tangent-train: level: found nix"):
        run("train", "level=7", "--config-dir", str(tmp_path), "level=nix")


@pytest.mark.parametrize("group", ["callbacks", "data@photos.data", "recipe", "scheduler"])
def test_groups_without_an_option(group: str, run: Run) -> None:
    command = "transfer" if "@" in group else "train"
    with pytest.raises(SystemExit, match=rf"^tangent-{command}: level: found nix"):
        run(command, f"{group}=null", "level=nix")
    with pytest.raises(SystemExit, match=rf"^tangent-{command}: network: found null; expected a s"):
        run(command, "network=null")
