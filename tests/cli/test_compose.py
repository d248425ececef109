"""Every config of the tree, composed once; where a command starts from a checkpoint."""

from __future__ import annotations

import inspect
from dataclasses import is_dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, get_args, get_type_hints

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser
from hypothesis import given, settings
from hypothesis import strategies as st
from omegaconf import OmegaConf

from tangent_train.cli.compose import literal_paths, path_text, quoted
from tangent_train.cli.stored import stored_run
from tangent_train.errors import DataError, SettingError
from tangent_train.files import config_folder
from tests.running import command_of, composed, composed_settings

EXPERIMENTS = sorted(
    path.relative_to(config_folder() / "experiment").with_suffix("").as_posix()
    for path in (config_folder() / "experiment").rglob("*.yaml")
)
GROUPS = (
    *("recipe", "representation", "optimizer", "scheduler", "network", "data", "trainer", "task"),
)


@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_every_experiment_composes(experiment: str) -> None:
    config = composed(command_of(experiment), f"experiment={experiment}")
    OmegaConf.resolve(config)
    assert config.name in (experiment, experiment.removeprefix("rooms/"))


@pytest.mark.parametrize("group", GROUPS)
def test_every_option_of_every_group_composes(group: str) -> None:
    for path in (config_folder() / group).glob("*.yaml"):
        OmegaConf.resolve(composed("train", f"{group}={path.stem}"))


@pytest.mark.parametrize("command", ["train", "transfer"])
@pytest.mark.parametrize("task", ["classification", "depth", "segmentation"])
def test_a_recipe_sets_what_the_task_has(task: str, command: str) -> None:
    plain, small = (
        composed_settings(command, f"task={task}", *more)["task"]
        for more in ((), ("recipe=small",))
    )
    weights = {"class_weights": "sqrt"} if task == "segmentation" else {}
    assert small == plain | {"channels_last": True} | weights


def test_a_command_starts_from_a_stored_run_only_where_there_is_one(tmp_path: Path) -> None:
    for command, argument in (("train", "resume=null"), ("evaluate", "checkpoint="), ("check", "")):
        assert stored_run(command, [argument]) is None
    with pytest.raises(DataError, match="the folder of a started run"):
        stored_run("train", [f"resume={tmp_path}"])
    with pytest.raises(DataError, match=r"found a folder; .*checkpoints/best\.ckpt"):
        stored_run("evaluate", [f"checkpoint={tmp_path}"])
    with pytest.raises(SettingError, match=r"checkpoint: found a\.ckpt, b\.ckpt; "):
        stored_run("evaluate", ["-m", "checkpoint=a.ckpt,b.ckpt"])


# Paths.

_ODD = (
    *("my (rooms), 2024", "2024", "1e3", "true", "a=b[x]{y}#1", "'a", "'a' b", "é.png", "日本.png"),
    *("x\\${oc.env:S}.png", "${oc.env:S}", " lead", "trail ", "new\nline", "back\\", "\udc80"),
)
_WITH_PATHS = {
    "check": "data.root data.cache +data.label_table",
    "predict": "input output checkpoint depth mask label_map",
    "render": "input output figure back poses cameras mask",
    "import": "model weights file classes output",
    "keypoints": "left right input output data.root",
    "export": "checkpoint",
    "evaluate": "checkpoint",
    "transfer": "photos.data.root",
    "train": "name init_from resume data.mask network.weights",
}


def _received(command: str, argument: str) -> Any:
    name = argument.partition("=")[0]
    return OmegaConf.select(composed(command, *literal_paths(command, [argument])), name)


@pytest.mark.parametrize(("command", "names"), _WITH_PATHS.items())
def test_settings_that_are_paths(command: str, names: str) -> None:
    for name in names.split():
        typed = [f"{name}={text}" for text in ("my (rooms), 2024", "é", "null", "")]
        quotes = [f"{name}={text}" for text in ("'my (rooms), 2024'", "'é'", "null", "null")]
        assert literal_paths(command, typed) == quotes


@pytest.mark.parametrize("text", _ODD)
def test_paths_are_taken_literally(text: str) -> None:
    assert _received("predict", f"input={text}") == text


@settings(max_examples=300, deadline=None)
@given(st.text() | st.text("ab'\"\\${}:,[](#= \n\t~%@é日\udc80\x1b"))
def test_typed_paths_arrive_unchanged(text: str) -> None:
    def arrived(argument: str) -> Any:
        (literal,) = literal_paths("predict", [argument])
        override = OverridesParser.create().parse_override(literal)
        return OmegaConf.create({"x": override.value()}).x

    in_hydras_quotes = path_text(text) != text
    if not in_hydras_quotes and text.lower() not in ("", "null"):
        assert arrived(f"input={text}") == text
    if text.lower() not in ("", "null"):
        assert arrived(f"input={quoted(text)}") == text


def test_the_home_folder_numbers_and_sweeps(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    home = str(tmp_path)
    monkeypatch.setenv("HOME", home)
    for text, path in (("~", home), ("~/a b", f"{home}/a b"), ("./~", "./~"), ("~x", "~x")):
        assert _received("predict", f"input={text}") == path
    assert _received("predict", "input='my rooms'") == "my rooms"
    assert _received("predict", "mask=2024") == 2024
    same = ["seed=2024", "data.mask=-60", "data.inputs=[rgb]", "network.depth=50"]
    same += ["optimizer.lr=1e-3"]
    assert literal_paths("train", same) == same
    swept = literal_paths("train", ["-m", "data.root=a b,'c, d',2024,o'neil", "seed=0,1"])
    assert swept == ["-m", r"data.root='a b','c, d','2024','o\'neil'", "seed=0,1"]
    kept = literal_paths("train", ["hydra.run.dir=my (runs)/${name}", "hydra.sweep.dir='a b'"])
    assert kept == ["hydra.run.dir='my (runs)/${name}'", "hydra.sweep.dir='a b'"]


@pytest.mark.parametrize(("section", "package"), [("data", "datamodules"), ("network", "models")])
def test_settings_are_paths_where_their_class_declares_it(section: str, package: str) -> None:
    home = import_module(package)
    for target in home.__all__:
        made = getattr(home, target)
        by_fields = is_dataclass(made) or inspect.isfunction(made)
        hints = get_type_hints(made if by_fields else made.__init__)
        # `labels` is also a file of an image: it is quoted, which does not change its value.
        for name in inspect.signature(made).parameters.keys() - {"labels"}:
            is_path = Path in (hints.get(name), *get_args(hints.get(name)))
            expected = f"{section}.{name}='a b'" if is_path else f"{section}.{name}=a b"
            assert literal_paths("train", [f"{section}.{name}=a b"]) == [expected], target


def test_paths_of_a_class_of_ones_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "my_maps.py").write_text(
        "import typing\nfrom pathlib import Path\nfrom datamodules import FolderPanoramas\n"
        "class Mine(FolderPanoramas):\n    maps: typing.Optional[Path]\n    scale: float\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    option = tmp_path / "my configs" / "data" / "mine.yaml"
    option.parent.mkdir(parents=True)
    option.write_text("_target_: my_maps.Mine\n")
    typed = [f"--config-dir={option.parents[1]}", "data.maps=2024", "data.root=ä", "data.scale=1e3"]
    assert literal_paths("check", typed)[1:] == ["data.maps='2024'", "data.root='ä'", typed[3]]
