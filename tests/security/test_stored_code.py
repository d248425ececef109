"""Settings in a file name no code that would be run, look nothing up and fetch nothing."""

from __future__ import annotations

import copy
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import onnx
import pytest
import torch
import torchvision
import yaml  # type: ignore[import-untyped]
from hydra import compose, initialize_config_dir
from safetensors.torch import save_file
from torch import Tensor, nn

from tangent_train.cli import main
from tangent_train.cli.compose import config_folder
from tangent_train.cli.stored import checkpoint_config, with_stored_config
from tangent_train.errors import DataError
from tangent_train.tasks.exported import (
    _TOUCHES_FILES,
    METADATA_KEY,
    torchscript_without_warnings,
)
from tangent_train.tasks.networks import completed_settings
from tangent_train.tasks.reports.runs import load_run
from tangent_train.tasks.stored_settings import check_stored, named_targets, read_settings
from tangent_train.checkpoints.trained import load_trained
from tests.tasks.small_networks import save_checkpoint, small_trained

Edit = Callable[[dict[str, Any], Path], None]
JIT: Any = torch.jit  # partly without types


@pytest.fixture(scope="module")
def harmless(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What is in a checkpoint."""
    path = tmp_path_factory.mktemp("harmless") / "best.ckpt"
    save_checkpoint(path, "network.widths=[4,8,8]", "data.inputs=[rgb]")
    content: dict[str, Any] = torch.load(path, weights_only=True)
    return content


def _edited(path: Path, content: dict[str, Any], edit: Edit, created: Path) -> Path:
    changed = copy.deepcopy(content)
    for name in ("config", "resolved_config"):
        edit(changed[name], created)
    path.parent.mkdir(parents=True, exist_ok=True)
    torch.save(changed, path)
    return path


def _command(created: Path) -> dict[str, Any]:
    return {"_target_": "os.mkdir", "path": str(created)}


def _network(config: dict[str, Any], created: Path) -> None:
    config["network"] = _command(created)


def _inner_network(config: dict[str, Any], created: Path) -> None:
    config["network"]["norm"] = [{"deep": _command(created)}]


def _representation(config: dict[str, Any], created: Path) -> None:
    config["representation"]["rotation"] = _command(created)


def _data(config: dict[str, Any], created: Path) -> None:
    config["data"]["rooms"] = _command(created)


def _optimizer(config: dict[str, Any], created: Path) -> None:
    config["optimizer"]["lr"] = _command(created)


def _trainer(config: dict[str, Any], created: Path) -> None:
    config["trainer"]["profiler"] = _command(created)


def _partial(config: dict[str, Any], created: Path) -> None:
    config["scheduler"] = _command(created) | {"_partial_": True}


def _referred(config: dict[str, Any], created: Path) -> None:
    config["name"] = "os.mkdir"
    config["network"] = {"_target_": "${name}", "path": str(created)}


def _made_of_text(config: dict[str, Any], created: Path) -> None:
    config["network"] = f"${{oc.create:{{_target_: os.mkdir, path: {created}}}}}"


def _through_a_module(config: dict[str, Any], created: Path) -> None:
    config["network"] = _command(created) | {"_target_": "torch.nn.functional.warnings.sys.exit"}


def _function_of_torch(config: dict[str, Any], created: Path) -> None:
    config["network"] = {"_target_": "torch.load", "f": str(created), "weights_only": False}


def _function_of_ours(config: dict[str, Any], created: Path) -> None:
    target = "tangent_train.files.write_text"
    config["network"] = {"_target_": target, "path": str(created), "content": "x"}


def _address(config: dict[str, Any], created: Path) -> None:
    config["network"] = {"_target_": "timm.create_model", "model_name": f"local-dir:{created}"}


def _positional_address(config: dict[str, Any], created: Path) -> None:
    config["network"] = {"_target_": "timm.create_model", "_args_": ["hf-hub:somebody/net"]}


def _weights_of_timm(config: dict[str, Any], created: Path) -> None:
    settings = {"model_name": "resnet18", "checkpoint_path": str(created)}
    config["network"] = {"_target_": "timm.create_model", **settings}


def _compiler(config: dict[str, Any], created: Path) -> None:
    config["task"]["compile"] = {"options": {"cpp.cxx": str(created)}}


NETWORKS: tuple[Edit, ...] = (
    _network,
    _inner_network,
    _representation,
    _referred,
    _made_of_text,
    _through_a_module,
    _function_of_torch,
    _function_of_ours,
    _address,
    _positional_address,
    _weights_of_timm,
)
EDITS: tuple[Edit, ...] = (*NETWORKS, _data, _optimizer, _trainer, _partial, _compiler)


@pytest.mark.parametrize("edit", EDITS)
def test_a_checkpoint_names_no_other_code(
    edit: Edit, harmless: dict[str, Any], tmp_path: Path
) -> None:
    created = tmp_path / "created"
    path = _edited(tmp_path / "x.ckpt", harmless, edit, created)
    with pytest.raises(DataError, match=r"x\.ckpt: found .*; expected settings of networks"):
        checkpoint_config(path)
    if edit in NETWORKS:
        with pytest.raises(DataError, match=r"x\.ckpt: found .*; expected settings of networks"):
            load_trained(path)
    assert not created.exists()


@pytest.mark.parametrize(
    ("command", "arguments"),
    [
        ("evaluate", ["checkpoint=run/checkpoints/last.ckpt"]),
        ("train", ["resume=run"]),
        ("predict", ["checkpoint=run/checkpoints/last.ckpt", "input=image.png", "output=labels"]),
        ("export", ["checkpoint=run/checkpoints/last.ckpt", "output=net.onnx"]),
    ],
)
def test_no_command_runs_it(
    command: str,
    arguments: list[str],
    harmless: dict[str, Any],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    created = tmp_path / "created"
    _edited(tmp_path / "run" / "checkpoints" / "last.ckpt", harmless, _network, created)
    (tmp_path / "image.png").touch()
    monkeypatch.setattr(sys, "argv", [f"tangent-{command}", *arguments])
    message = r"last\.ckpt: found network\._target_=os\.mkdir, which would be called.*trust=os\.mk"
    with pytest.raises(SystemExit, match=message):
        getattr(main, command)()
    assert not created.exists()


def test_a_transfer_imports_nothing_that_it_names(
    harmless: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def edit(config: dict[str, Any], _: Path) -> None:
        config["data"]["_target_"] = "antigravity.fly"

    monkeypatch.chdir(tmp_path)
    _edited(tmp_path / "x.ckpt", harmless, edit, tmp_path)
    arguments = ["experiment=rooms/transfer", "checkpoint=x.ckpt"]
    monkeypatch.setattr(sys, "argv", ["tangent-transfer", *arguments])
    with pytest.raises(SystemExit, match=r"_target_=antigravity\.fly, which would be called"):
        main.transfer()
    assert "antigravity" not in sys.modules


class Own(nn.Conv2d):
    """A network of a user."""

    def __init__(self, in_channels: int, num_classes: int) -> None:
        super().__init__(in_channels, num_classes, 1)


def _own(content: dict[str, Any], path: Path) -> Path:
    changed = copy.deepcopy(content)
    for name in ("config", "resolved_config"):
        null = {"in_channels": None, "num_classes": None}
        changed[name]["network"] = {"_target_": f"{__name__}.Own", **null}
    count = len(content["class_names"])
    changed["state_dict"] = {f"network.{n}": t for n, t in Own(3, count).state_dict().items()}
    torch.save(changed, path)
    return path


def test_ones_own_network_is_trusted_by_its_name(harmless: dict[str, Any], tmp_path: Path) -> None:
    path = _own(harmless, tmp_path / "x.ckpt")
    name = f"{__name__}.Own"
    with pytest.raises(DataError, match=f"trust={name}"):
        load_trained(path)
    assert load_trained(path, [name]).in_channels == 3
    for said in (f"trust={name}", f"trust=['{name}',my.Other]", f"network._target_={name}"):
        stored, arguments = with_stored_config("evaluate", [f"checkpoint={path}", said])
        assert stored == "stored_evaluate"
        assert not any(argument.startswith("trust=") for argument in arguments)
    with pytest.raises(DataError, match=f"trust={name}"):
        with_stored_config("evaluate", [f"checkpoint={path}", "trust=my.Other"])


def test_a_command_takes_what_is_trusted(
    harmless: dict[str, Any],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    _own(harmless, tmp_path / "x.ckpt")
    monkeypatch.chdir(tmp_path)
    line = ["tangent-export", "checkpoint=x.ckpt", "output=x.safetensors"]
    monkeypatch.setattr(sys, "argv", [*line, "trust=3"])
    with pytest.raises(SystemExit, match="trust: found 3; expected a name, or a list of names"):
        main.export()
    monkeypatch.setattr(sys, "argv", [*line, f"trust={__name__}.Own"])
    main.export()
    with pytest.raises(DataError, match=f"trust={__name__}.Own"):
        load_trained(tmp_path / "x.safetensors")


def test_all_that_the_configs_name_is_known() -> None:
    for path in sorted(config_folder().rglob("*.yaml")):
        settings = yaml.safe_load(path.read_text())
        targets = named_targets(settings)
        of_pairs = {name for name in targets if name.endswith("Pairs")}  # of no checkpoint
        check_stored(path, settings.get("network", {}) if of_pairs else _section(settings))


def _section(settings: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in settings.items() if name not in ("hydra", "name")}


@pytest.mark.parametrize(
    "name",
    [
        "models.initialize",
        "torch.hub.load",
        "torch.nn.Module.load_state_dict",
        "torch.nn.modules.conv.Conv2d",
        "torch.nn._reduction",
        "torch.optim.os",
        "torchvision.models.get_model",
        "torchvision.models.segmentation.resnet18",
        "segmentation_models_pytorch.from_pretrained",
        "timm.models.load_checkpoint",
        "lightning.LightningModule.load_from_checkpoint",
        "builtins.eval",
        "eval",
        "",
        None,
        3,
        ["os.system"],
    ],
)
def test_what_is_near_to_what_is_known_is_not_known(name: Any, tmp_path: Path) -> None:
    with pytest.raises(DataError, match="which would be called"):
        check_stored(tmp_path, {"x": [{"_target_": name if name is not None else "None"}]})


@pytest.mark.parametrize(
    "settings",
    [
        {"_target_": "torch.nn.Sequential", "_args_": [{"_target_": "torch.nn.Conv2d"}]},
        {"_target_": "torchvision.models.segmentation.fcn_resnet50"},
        {"_target_": "torch.optim.SGD", "lr": "${optimizer.lr}"},
        {"_target_": "segmentation_models_pytorch.FPN", "encoder_name": "tu-convnext_atto"},
        {"_target_": "timm.create_model", "model_name": "resnet18.a1_in1k", "pretrained": True},
        {"_target_": "lightning.Trainer", "profiler": "simple"},
    ],
)
def test_networks_of_the_libraries_need_no_trust(settings: Any, tmp_path: Path) -> None:
    check_stored(tmp_path, {"network": settings})


def test_the_environment_is_not_looked_up(
    harmless: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SECRET", "sesame")
    content = copy.deepcopy(harmless)
    content["config"]["data"] |= {"root": "${oc.env:SECRET}/x", "list": ["${oc.env:SECRET}"]}
    content["resolved_config"]["data"] |= {"root": "as it was/x", "list": ["then"]}
    torch.save(content, tmp_path / "x.ckpt")
    with_stored_config("evaluate", [f"checkpoint={tmp_path / 'x.ckpt'}"])
    with initialize_config_dir(str(config_folder()), version_base="1.3"):
        config = compose("stored_evaluate")
    assert config.data.root == "as it was/x"
    assert config.data.list == ["then"]
    for nested in ("${oc.env:SECRET}", "${ oc.env : SECRET}", "${a.${oc.env:SECRET}}"):
        content["config"]["data"]["root"] = nested
        content["resolved_config"]["data"]["root"] = nested
        torch.save(content, tmp_path / "x.ckpt")
        with pytest.raises(DataError, match="looked up outside of the settings"):
            checkpoint_config(tmp_path / "x.ckpt")


def test_a_report_looks_nothing_up_and_follows_no_aliases(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SECRET", "sesame")
    path = tmp_path / "config.yaml"
    path.write_text("level: 5\nrows: ${level}\nroot: ${oc.env:SECRET}/x\nlist: ['${oc.env:A}']\n")
    found = {"level": 5, "rows": 5, "root": "${oc.env:SECRET}/x", "list": ["${oc.env:A}"]}
    assert read_settings(path) == found
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x]"]
    lines += [f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 9)}]" for k in range(1, 12)]
    path.write_text("\n".join(lines))
    figures = dict.fromkeys(("miou", "macc", "miou_solid_angle", "macc_solid_angle"), 0.5)
    (tmp_path / "results.json").write_text(json.dumps(figures | {"classes": []}))
    with pytest.raises(DataError, match=r"config\.yaml: found ValueError: an alias"):
        load_run(tmp_path)


def test_settings_without_end_are_refused(harmless: dict[str, Any], tmp_path: Path) -> None:
    deep: Any = []
    for _ in range(5000):
        deep = [deep]
    path = tmp_path / "x.ckpt"
    with pytest.raises(DataError, match="without end"):
        check_stored(path, deep)
    (tmp_path / "config.yaml").write_text("x: " + "[" * 5000 + "]" * 5000)
    (tmp_path / "results.json").write_text("[" * 200_000)
    with pytest.raises(DataError, match=r"results\.json"):
        load_run(tmp_path)


@pytest.mark.parametrize("name", ["settings", "representation"])
def test_exported_networks_name_no_other_code(name: str, tmp_path: Path) -> None:
    """Beside the numbers of a network there is JSON in all three formats."""
    trained = small_trained()
    created = tmp_path / "created"
    described = {
        "settings": completed_settings(trained.settings, 4, 5),
        "class_names": trained.class_names,
        "inputs": trained.inputs,
        "normalization": {"mean": [0, 0, 0, 0], "std": [1, 1, 1, 1]},
        "level": 5,
        "representation": trained.representation,
        "image_size": (32, 32),
        "size_multiple": 4,
        "fixed_size": None,
    }
    text = json.dumps(described | {name: _command(created)})
    tensors = {n: t.contiguous() for n, t in trained.network.network.state_dict().items()}  # type: ignore[union-attr]
    save_file(tensors, tmp_path / "x.safetensors", {METADATA_KEY: text})
    node = onnx.helper.make_node("Identity", ["images"], ["scores"])
    ends = [
        onnx.helper.make_tensor_value_info(end, onnx.TensorProto.FLOAT, [None] * 4)
        for end in ("images", "scores")
    ]
    graph = onnx.helper.make_graph([node], "x", ends[:1], ends[1:])
    opset = [onnx.helper.make_opsetid("", 17)]
    model = onnx.helper.make_model(graph, opset_imports=opset, ir_version=9)
    onnx.helper.set_model_props(model, {METADATA_KEY: text})
    onnx.save(model, tmp_path / "x.onnx")
    with torchscript_without_warnings():
        script: Any = JIT.trace(nn.Identity(), torch.zeros(1, 4, 8, 8))
        torch.jit.save(script, tmp_path / "x.pt", _extra_files={METADATA_KEY: text})
    for suffix in ("safetensors", "onnx", "pt"):
        with pytest.raises(DataError, match=f"found {name}._target_=os.mkdir, which would be"):
            load_trained(tmp_path / f"x.{suffix}")
        assert not created.exists()


class Saving(nn.Module):
    """Writes a file when it is loaded, and when it is used."""

    def __init__(self, path: str) -> None:
        super().__init__()
        self.path = path

    def forward(self, images: Tensor) -> Tensor:
        torch.save(images, self.path)
        return images


class SavingAtOnce(Saving):
    @torch.jit.export
    def __getstate__(self) -> tuple[str, bool]:
        return self.path, self.training

    @torch.jit.export
    def __setstate__(self, state: tuple[str, bool]) -> None:
        self.path, self.training = state
        torch.save(1, self.path)


@pytest.mark.parametrize("kind", [Saving, SavingAtOnce])
def test_torchscript_that_writes_files_is_refused_before_it_runs(
    kind: type[Saving], tmp_path: Path
) -> None:
    created, path = tmp_path / "created", tmp_path / "x.pt"
    with torchscript_without_warnings():
        script: Any = torch.jit.script(kind(str(created)))
        torch.jit.save(script, path)
        created.unlink(missing_ok=True)
        again: Any = JIT.load(path)
        again(torch.zeros(1))
    assert created.exists(), "else this could not fail"
    created.unlink()
    with pytest.raises(DataError, match=r"x\.pt: found a program that calls save"):
        load_trained(path)
    assert not created.exists()


def test_torchscript_has_no_other_operations_on_files() -> None:
    assert torchvision.extension._has_ops(), "whose operations are there once it is imported"
    schemas: Any = torch._C._jit_get_all_schemas()
    named = {
        schema.name.partition("::")[2]
        for schema in schemas
        for argument in schema.arguments
        if any(word in argument.name.lower() for word in ("file", "path", "url", "dir"))
        and "str" in str(argument.type)
    }
    assert {"save", "from_file", "write_file"} <= named
    assert all(_TOUCHES_FILES.fullmatch(name.encode()) for name in named)
