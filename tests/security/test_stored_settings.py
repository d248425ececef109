"""Settings inside checkpoints and runs: what they may say, and what is looked up here instead."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml  # type: ignore[import-untyped]
from rich.console import Console
from torch import nn

from models import initialize
from tangent_train.callbacks.checkpoints import BestCheckpoint
from tangent_train.checkpoints.content import read_settings
from tangent_train.checkpoints.loaded import completed_settings, load_network
from tangent_train.cli.run import build
from tangent_train.config import build as registry
from tangent_train.config.build import SettingsFile, build_from_config
from tangent_train.errors import DataError, SettingError
from tangent_train.files import config_folder
from tests.cli.tiny_runs import results, run_command
from tests.running import Patch
from tests.security.attacks import CANARY
from tests.security.honest import SETTINGS, settled, with_config
from tests.security.watch import watched

_FIRE = f"{CANARY}.fire"
_UNET = {"_target_": "models.UNet", "in_channels": 3, "num_classes": 13, "widths": [4, 8]}


def test_settings_of_this_machine_are_not_taken_from_a_file(
    content: dict[str, Any], forbidden: Path
) -> None:
    """Compiler options, folders and the number of processes."""
    options = {"options": {"cxx": f"sh -c 'id > {forbidden}/x'"}}
    config = content["config"]
    many = {"devices": 3, "strategy": "ddp", "num_nodes": 2, "accelerator": "gpu"}
    path = with_config(
        content,
        forbidden.parent,
        task=config["task"] | {"compile": options},
        data=config["data"] | {"root": str(forbidden), "store": "/x"},
        trainer=config["trainer"] | many | {"model_registry": "x", "max_time": "00:01:00"},
    )
    with watched(forbidden) as happened:
        settings, _ = settled(path, "task.compile={mode: max-autotune}", root="mine")
        assert settings["task"]["compile"] == {"mode": "max-autotune"}
        settings, _ = settled(path, root="mine")
    assert not happened
    assert settings["task"].get("compile") is None
    assert settings["data"]["root"] == "mine"
    assert settings["data"].get("store") is None
    assert settings["trainer"]["devices"] == settings["trainer"]["accelerator"] == "auto"
    assert not {"strategy", "num_nodes", "model_registry", "max_time"} & settings["trainer"].keys()
    with pytest.raises(SettingError, match=r"data\.root: found .*The run had data\.root="):
        settled(path, root=None)
    changed_path = with_config(
        content, forbidden.parent, data=config["data"] | {"root": "data/rooms_demo"}
    )
    assert settled(changed_path, root=None)[0]["data"]["root"] == "data/rooms_demo", (
        "as one's own config"
    )


def test_a_mask_is_a_latitude_in_a_file_and_a_path_of_ones_own(
    content: dict[str, Any], tmp_path: Path
) -> None:
    def masked(mask: Any, *text: str) -> tuple[Any, SettingsFile]:
        data = content["config"]["data"] | {"mask": mask}
        settings, source = settled(with_config(content, tmp_path, data=data), *text)
        return settings["data"]["mask"], source

    assert masked(-60)[0] == -60
    assert masked(-60, "data.mask=null")[0] is None
    mask, source = masked(-60, "data.mask=pole.png")
    assert (mask, source.gave("data.mask")) == ("pole.png", False)
    with pytest.raises(SettingError, match=r"data\.mask: found null.*had data\.mask='pole\.png'"):
        masked("pole.png")

    settings, source = settled(with_config(content, tmp_path))
    settings["data"] |= {"mask": "pole.png"}
    with pytest.raises(DataError, match=r"data\.mask='pole\.png'; expected .*float"):
        build(settings, source)


def test_names_of_options_are_not_paths(
    content: dict[str, Any], forbidden: Path, monkeypatch: Patch
) -> None:
    monkeypatch.chdir(forbidden.parent)
    (forbidden / "data").mkdir()
    target = content["config"]["data"]["_target_"]
    option = f"# @package data\n_target_: {target}\nroot: rooms\nstore: x_${{oc.env:SECRET}}\n"
    (forbidden / "data" / "z.yaml").write_text(option)
    up = "/".join([".."] * 30)
    for option in (f"{up}{forbidden}/data/z", "../data/folder", "a\0b/c", "z", "x\nseed=3"):
        for group in ("data", "experiment", "trainer"):
            path = with_config(content, forbidden.parent, choices={group: option})
            with watched(forbidden) as happened:
                try:
                    settings, _ = settled(path)
                except DataError as error:
                    assert "choices" in str(error)  # noqa: PT017 - either is right
                else:
                    assert settings["data"].get("store") is None
                    assert settings["seed"] == 0
            assert not [event for event in happened if "z.yaml" in event]


@pytest.mark.parametrize("name", ["..", "/", "notes.txt", "/etc/passwd"])
def test_where_the_best_epoch_is_does_not_come_out_of_a_file(name: str, tmp_path: Path) -> None:
    """Lightning removes the one that was the best before: once the whole folder, by its state."""
    best = BestCheckpoint(tmp_path)
    low = torch.tensor(-1.0)
    state = dict.fromkeys(("best_model_path", "kth_best_model_path", "last_model_path"), name)
    scores = dict.fromkeys(("best_model_score", "current_score", "kth_value"), low)
    best.load_state_dict({**state, **scores, "best_k_models": {name: low}, "dirpath": "/"})
    local_path = str(tmp_path / "best.ckpt")
    assert best.dirpath == str(tmp_path)
    assert {best.best_model_path, best.kth_best_model_path, *best.best_k_models} == {local_path}
    assert best.last_model_path == ""
    assert best.best_model_score == -1


def test_checkpoints_that_cannot_be_resumed_are_refused_in_a_line(
    run: Path, content: dict[str, Any], tmp_path: Path, monkeypatch: Patch
) -> None:
    monkeypatch.chdir(run.parent)
    option = tmp_path / "theirs"
    (option / "checkpoints").mkdir(parents=True)
    text = "found a checkpoint that cannot be resumed"
    endless = {**content["config"], "trainer": {**content["config"]["trainer"], "max_epochs": {}}}
    for changed, message in (
        ({"callbacks": "x"}, text),
        ({"state_dict": {}}, text),
        ({"optimizer_states": [{"state": {}, "param_groups": "x"}]}, text),
        ({"config": endless}, r"trainer\.max_epochs"),
    ):
        torch.save(content | changed, option / "checkpoints" / "last.ckpt")
        with pytest.raises(SystemExit, match=rf"^tangent-train: .*{message}"):
            run_command(monkeypatch, "train", f"resume={option}", "data.root=rooms")


def test_terminals_get_no_commands(content: dict[str, Any], run: Path, tmp_path: Path) -> None:
    evil = "a.b\x1b]0;owned\x07\n\x1b[31mtrust me"
    path = with_config(content, tmp_path, network={"_target_": evil})
    with pytest.raises(DataError) as refused:
        load_network(path)
    assert "\x1b" not in str(refused.value)
    for name in (evil, "a\nb"):
        torch.save(content | {"class_names": [name] * 14}, path)
        with pytest.raises(DataError, match="class_names="):
            load_network(path)
    settings = read_settings(run / "config.yaml") | {"name": evil}
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(settings))
    with pytest.raises(DataError, match=r"settings\.name="):
        read_settings(tmp_path / "config.yaml")
    network = build_from_config(_UNET, "network")
    torch.save({"[/nope][link=x]" + evil: torch.zeros(1), **network.state_dict()}, path)
    console = Console(record=True, width=200, force_terminal=True)
    console.print(str(initialize(network, path)), markup=False)
    shown = console.export_text()
    assert "[/nope][link=x]a.b" in shown
    assert "\x07" not in shown


@pytest.mark.parametrize("override", ["+network.inner={a.b:1}", "name='a\x1b[2J'"])
def test_settings_that_readers_refuse_are_not_trained(
    override: str, run: Path, tmp_path: Path, monkeypatch: Patch
) -> None:
    """A user-defined network takes any settings; its checkpoints must be readable."""
    monkeypatch.chdir(run.parent)
    changed_path = ("data.root=rooms", f"network._target_={OWN}", "~network.widths", override)
    refused = pytest.raises(SystemExit, match=r"config\.yaml: found .*settings\.n.*; expected ")
    with refused:
        run_command(monkeypatch, "train", *SETTINGS, *changed_path, f"hydra.run.dir={tmp_path}/run")
    assert not (tmp_path / "run" / "checkpoints").exists()


def test_aliases_in_settings_are_not_followed(tmp_path: Path) -> None:
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x]"]
    lines += [f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 9)}]" for k in range(1, 12)]
    (tmp_path / "config.yaml").write_text("\n".join(lines))
    with pytest.raises(DataError, match=r"config\.yaml: found YAMLError: an alias"):
        read_settings(tmp_path / "config.yaml")
    (tmp_path / "config.yaml").write_text("x: " + "[" * 1500 + "]" * 1500)
    with pytest.raises(DataError, match=r"config\.yaml: found RecursionError"):
        read_settings(tmp_path / "config.yaml")


class Own(nn.Conv2d):
    """A network of a user."""

    def __init__(self, in_channels: int, num_classes: int, inner: Any = None) -> None:
        super().__init__(in_channels, num_classes, 1)


OWN = f"{__name__}.Own"


def _with_network(content: dict[str, Any], path: Path, **settings: Any) -> Path:
    network = {"_target_": OWN, "in_channels": 3, "num_classes": 13, **settings}
    tensors = {f"network.{n}": t for n, t in Own(3, 13).state_dict().items()}
    changed = content | {"config": content["config"] | {"network": network}}
    torch.save(changed | {"state_dict": tensors}, path)
    return path


def test_ones_own_network_is_trusted_by_its_name(content: dict[str, Any], tmp_path: Path) -> None:
    path = _with_network(content, tmp_path / "x.ckpt")
    with pytest.raises(DataError, match=f"trust={OWN}"):
        load_network(path)
    assert load_network(path, [OWN]).in_channels == 3
    for text in (f"trust={OWN}", f"trust=['{OWN}',my.Other]", f"network._target_={OWN}"):
        build(*settled(path, text))
    with pytest.raises(DataError, match=f"trust={OWN}"):
        build(*settled(path, "trust=my.Other"))
    # Its arguments may be any plain values, but objects inside are still checked.
    path = _with_network(content, tmp_path / "x.ckpt", inner={"a": [{"_target_": _FIRE}]})
    with pytest.raises(DataError, match=rf"network\.inner\.a\.0\._target_={_FIRE}"):
        load_network(path, [OWN])


@pytest.mark.parametrize("section", ["optimizer", "scheduler"])
def test_an_evaluation_needs_no_trust_for_what_only_trains(
    section: str, run: Path, content: dict[str, Any], tmp_path: Path, monkeypatch: Patch
) -> None:
    monkeypatch.chdir(run.parent)
    named = {section: {"_target_": _FIRE, "_partial_": True}}
    path = with_config(content, tmp_path, **named)
    text = (f"checkpoint={path}", "data.root=rooms", f"hydra.run.dir={tmp_path}/evaluated")
    with watched(tmp_path / "forbidden") as happened:
        run_command(monkeypatch, "evaluate", *text)
    assert happened == []
    assert results(tmp_path / "evaluated") == results(run)
    with pytest.raises(SystemExit, match=rf"{section}\._target_={_FIRE}, which would be called"):
        run_command(monkeypatch, "train", f"resume={path.parents[1]}", "data.root=rooms")


def test_files_may_name_all_that_the_configs_name() -> None:
    folder = config_folder()
    never = {path for group in ("callbacks", "logger") for path in (folder / group).iterdir()}
    for path in sorted({*folder.rglob("*.yaml")} - never):
        for target in re.findall(r"^ *_target_: (\S+)", path.read_text(), re.MULTILINE):
            # tangent-keypoints leaves no checkpoint; files have no section of Hydra.
            if not target.endswith(("Pairs", ".RunFolder")):
                assert registry._find(target) is not None, (path, target)


@pytest.mark.parametrize(
    "network",
    [
        {"_target_": "torch.nn.Conv2d", "in_channels": 3, "out_channels": 14, "kernel_size": 1},
        {"_target_": "torchvision.models.segmentation.fcn_resnet50", "weights": "DEFAULT"},
        {"_target_": "segmentation_models_pytorch.FPN", "encoder_name": "tu-convnext_atto"},
        {"_target_": "timm.create_model", "model_name": "resnet18.a1_in1k", "pretrained": True},
    ],
)
def test_networks_of_libraries_need_no_trust_and_fetch_nothing(
    network: dict[str, Any], tmp_path: Path
) -> None:
    settings = completed_settings(network, 3, 14, restored=True)
    with watched(tmp_path / "forbidden") as happened, torch.device("meta"):
        build_from_config(settings, "network", SettingsFile(tmp_path))
    assert not happened
