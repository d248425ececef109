"""Files of other people run nothing, look nothing up and fetch nothing."""

from __future__ import annotations

import csv
import json
import re
import shutil
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import onnx
import pytest
import torch
import yaml  # type: ignore[import-untyped]
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf
from rich.console import Console
from safetensors.torch import load_file, save_file
from torch import nn

from datamodules.core.samples import Input
from models import initialize
from tangent_train import registry
from tangent_train.callbacks.checkpoints import AtomicCheckpointIO, best_checkpoint
from tangent_train.checkpoints.content import INPUTS, read_checkpoint, read_settings
from tangent_train.checkpoints.trained import (
    METADATA_KEY,
    completed_settings,
    inputs_in,
    load_trained,
)
from tangent_train.cli import main
from tangent_train.cli import stored as stored_module
from tangent_train.cli.build import build
from tangent_train.cli.compose import check_overrides, config_folder
from tangent_train.cli.keypoints import earlier_results
from tangent_train.cli.stored import CHOOSABLE, StoredRun, stored_run
from tangent_train.errors import DataError, SettingError
from tangent_train.registry import accept, check_plain, make, named_targets
from tangent_train.rendering.camera_files import read_cameras
from tangent_train.results.record import load_record
from tests.datamodules.folder.folder_format import write_classes, write_data_set
from tests.security.attacks import attacks, json_attacks, places, replaced, sampled
from tests.security.watch import CANARY, watched

SECRET = "sesame-open"
SETTINGS = [
    "experiment=rooms/demo",
    "level=4",
    "network.widths=[4,8]",
    "representation.crop_multiple=null",
    "data.panoramas_per_step=1",
    "data.validation_fraction=0.2",
    "data.inputs=[rgb]",
    "data.rooms.height=32",
    "data.rooms.rooms={area_1: 2, area_2: 1, area_5a: 1}",
    "trainer.accelerator=cpu",
    "trainer.max_epochs=1",
    "panels=0",
    "tensorboard_images=0",
]


def _run(monkeypatch: pytest.MonkeyPatch, command: str, *arguments: str) -> None:
    monkeypatch.setattr(sys, "argv", [f"tangent-{command}", *arguments])
    getattr(main, command)()


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a finished run; beside it its data and the network as other files."""
    folder = tmp_path_factory.mktemp("honest")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        _run(patch, "train", *SETTINGS, "data.root=rooms", "hydra.run.dir=run")
        checkpoint = "checkpoint=run/checkpoints/last.ckpt"
        for name in ("net.onnx", "net.safetensors"):
            _run(patch, "export", checkpoint, f"output={name}")
    return folder / "run"


@pytest.fixture(scope="module")
def content(run: Path) -> dict[str, Any]:
    """What is in its checkpoint."""
    found: dict[str, Any] = torch.load(run / "checkpoints" / "last.ckpt", weights_only=True)
    return found


@pytest.fixture
def forbidden(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder that only attacks name."""
    monkeypatch.setenv("SECRET", SECRET)
    folder = tmp_path / "forbidden"
    folder.mkdir()
    (folder / "config.json").write_text("{}")  # whoever opens it is seen
    return folder


def _settled(
    path: Path, *said: str, root: str | None = "rooms"
) -> tuple[dict[str, Any], tuple[str, ...]]:
    """The settings of tangent-evaluate."""
    stored, typed = _typed(path, *said, *([] if root is None else [f"data.root={root}"]))
    with initialize_config_dir(str(config_folder()), version_base="1.3"):
        return stored.settings(typed, ())


def _typed(path: Path, *said: str) -> tuple[StoredRun, dict[str, Any]]:
    stored = stored_run("evaluate", [f"checkpoint={path}", *said])
    assert stored is not None
    check_overrides(stored.name, stored.arguments, stored.known, CHOOSABLE)
    with initialize_config_dir(str(config_folder()), version_base="1.3"):
        typed: Any = OmegaConf.to_container(compose(stored.name, stored.additions()), resolve=True)
    return stored, typed


def _nothing_happens(use: Callable[[Path], Any], path: Path, forbidden: Path, what: object) -> None:
    """Use a file: it is taken for what it is, or refused in one line that names it."""
    with watched(forbidden) as happened, suppress(DataError, SettingError):
        use(path)
    assert not happened, (what, happened)
    assert [path.name for path in forbidden.iterdir()] == ["config.json"], what


def _in_checkpoint(
    content: dict[str, Any], forbidden: Path, each: int | None, only: Sequence[str]
) -> Iterator[tuple[Path, object]]:
    path = forbidden.parent / "x.ckpt"
    lighter = content | {"optimizer_states": [], "loops": {}}
    all_places = [("config", *place) for place in places(content["config"])]
    all_places += [(name,) for name in ("config", "class_names", "inputs", "kind", "state_dict")]
    all_places += [("normalization",), ("normalization", "mean")]
    all_places = [("config", name) for name in only] or all_places
    for place, value in sampled(list(attacks(forbidden)), all_places, each):
        torch.save(replaced(lighter, place, value), path)
        yield path, (place, value)


def _attack_checkpoints(
    content: dict[str, Any], forbidden: Path, each: int | None, only: Sequence[str] = ()
) -> None:
    honest = forbidden.parent / "honest.ckpt"
    torch.save(content, honest)
    stored, typed = _typed(honest, "data.root=rooms")

    def evaluated(path: Path) -> None:
        config = check_plain(path, read_checkpoint(path, ("config",))["config"], "config")
        with pytest.MonkeyPatch.context() as patch:  # what the user has is not what is attacked
            patch.setattr(stored_module, "_composed_here", lambda *_: {})
            settings = replace(stored, path=path, config=config).settings(typed, ())
        build(*settings)

    for path, what in _in_checkpoint(content, forbidden, each, only):
        for use in (load_trained, evaluated, inputs_in):
            _nothing_happens(use, path, forbidden, what)


def test_nothing_in_a_checkpoint_is_interpreted(content: dict[str, Any], forbidden: Path) -> None:
    _attack_checkpoints(content, forbidden, each=2)


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_no_attack_at_any_place_of_a_checkpoint_is_interpreted(
    content: dict[str, Any], forbidden: Path
) -> None:
    _attack_checkpoints(content, forbidden, each=10)


def _without_the_registry(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(
        registry, "_find", lambda target, *_: (registry.import_named(target, "x"), {"**": Any})
    )


def _without_kinds(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(registry, "_fits", lambda value, kind: True)


def _without_depth(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(registry, "_DEEPEST", 10**9)


def _without_words(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(registry, "_WORD", re.compile(".*", re.DOTALL))


@pytest.mark.parametrize(
    "taken_out", [_without_the_registry, _without_kinds, _without_depth, _without_words]
)
def test_the_attacks_are_noticed_when_a_check_is_taken_out(
    taken_out: Callable[[pytest.MonkeyPatch], None],
    content: dict[str, Any],
    forbidden: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("socket.getaddrinfo", _no_network)
    taken_out(monkeypatch)
    with pytest.raises(BaseException, match=r"(?s).") as raised:
        _attack_checkpoints(content, forbidden, each=None, only=("network", "representation"))
    assert not isinstance(raised.value, DataError | SettingError)


def _no_network(*_: object, **__: object) -> None:
    raise AssertionError("the network was asked for")


def _described(run: Path) -> dict[str, Any]:
    header = (run.parent / "net.safetensors").read_bytes()
    length = int.from_bytes(header[:8], "little")
    text = json.loads(header[8 : 8 + length])["__metadata__"][METADATA_KEY]
    described: dict[str, Any] = json.loads(text)
    return described


def _exported(run: Path, folder: Path) -> Callable[[str], list[Path]]:
    """Writes the network with other metadata, as ONNX and as safetensors."""
    tensors = load_file(run.parent / "net.safetensors")
    node = onnx.helper.make_node("Identity", ["images"], ["scores"])
    ends = [
        onnx.helper.make_tensor_value_info(end, onnx.TensorProto.FLOAT, [None] * 4)
        for end in ("images", "scores")
    ]
    graph = onnx.helper.make_graph([node], "x", ends[:1], ends[1:])
    opset = [onnx.helper.make_opsetid("", 17)]
    model = onnx.helper.make_model(graph, opset_imports=opset, ir_version=9)

    def write(text: str) -> list[Path]:
        save_file(tensors, folder / "x.safetensors", {METADATA_KEY: text})
        onnx.helper.set_model_props(model, {METADATA_KEY: text})
        onnx.save(model, folder / "x.onnx")
        return [folder / "x.safetensors", folder / "x.onnx"]

    return write


def test_nothing_in_an_exported_network_is_interpreted(run: Path, forbidden: Path) -> None:
    described, write = _described(run), _exported(run, forbidden.parent)
    all_places = list(places(described))
    for place, value in sampled(list(json_attacks(forbidden)), all_places, each=2):
        for path in write(json.dumps(replaced(described, place, value))):
            _nothing_happens(load_trained, path, forbidden, (place, value))
            _nothing_happens(inputs_in, path, forbidden, (place, value))


def test_nothing_in_the_settings_of_a_run_is_interpreted(run: Path, forbidden: Path) -> None:
    folder = forbidden.parent / "theirs"
    shutil.copytree(run, folder, ignore=shutil.ignore_patterns("tensorboard", "checkpoints"))
    settings = read_settings(run / "config.yaml")
    for place, value in sampled(list(json_attacks(forbidden)), list(places(settings)), each=2):
        (folder / "config.yaml").write_text(yaml.safe_dump(replaced(settings, place, value)))
        _nothing_happens(load_record, folder, forbidden, (place, value))


def test_nothing_in_lists_of_cameras_and_results_of_keypoints_is_interpreted(
    run: Path, forbidden: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(forbidden.parent)
    panorama = next((run.parent / "rooms").rglob("*equirectangular_domain_rgb.png"))
    _run(monkeypatch, "render", f"input={panorama}", "output=tangent", "level=4", "base_level=0")
    cameras = next(Path("tangent").rglob("cameras.json"))
    Path("found").mkdir()
    results = Path("found") / "results.json"
    pairs = {"settings": {"level": 5}, "rows": [{"pair": "a", "pmr": 0.5}]}
    for path, use, honest in (
        (cameras, read_cameras, json.loads(cameras.read_text())),
        (results, lambda p: earlier_results(p.parent, {"level": 5}), pairs),
    ):
        for place, value in sampled(list(json_attacks(forbidden)), list(places(honest)), each=1):
            path.write_text(json.dumps(replaced(honest, place, value)))
            _nothing_happens(use, path, forbidden, (path, place, value))


def _hostile(content: dict[str, Any], folder: Path, **sections: Any) -> Path:
    """A run whose settings hold something else."""
    path = folder / "run" / "checkpoints" / "last.ckpt"
    path.parent.mkdir(parents=True, exist_ok=True)
    torch.save(content | {"config": content["config"] | sections}, path)
    return path


_FIRE = f"{CANARY}.fire"
_UNET = {"_target_": "models.UNet", "in_channels": 3, "num_classes": 14, "widths": [4, 8]}
_TIMM = {"_target_": "timm.create_model"}
WAYS: dict[str, tuple[dict[str, Any], str]] = {
    "code": ({"network": {"_target_": _FIRE}}, rf"network\._target_={_FIRE}.*trust={_FIRE}"),
    "text for a section": ({"network": f"_target_: {_FIRE}"}, "network="),
    "resolver": (
        {"network": f"${{oc.create:{{_target_: {_FIRE}}}}}"},
        "network=",
    ),
    "nested resolver": (
        {"network": _UNET | {"widths": f"${{oc.${{c}}:{{_target_: {_FIRE}}}}}"}, "c": "create"},
        r"network\.widths=",
    ),
    "reference": (
        {"network": _TIMM | {"model_name": "${note}"}, "note": "hf-hub:somebody/net"},
        r"network\.model_name=",
    ),
    "positional": (
        {"network": _TIMM | {"_args_": ["resnet18", True, {"hf_hub_id": "a/b"}]}},
        r"network\._args_=",
    ),
    "weights by position": (
        {"network": _TIMM | {"_args_": ["resnet18", False, None, None, "x.pth"]}},
        r"network\._args_=",
    ),
}
COMMANDS = {
    "evaluate": ["checkpoint=run/checkpoints/last.ckpt", "data.root=rooms"],
    "train": ["resume=run", "data.root=rooms"],
    "predict": ["checkpoint=run/checkpoints/last.ckpt", "input=image.png", "output=labels"],
    "export": ["checkpoint=run/checkpoints/last.ckpt", "output=net.onnx"],
}


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize("way", WAYS)
def test_every_command_refuses_what_once_ran(
    way: str,
    command: str,
    content: dict[str, Any],
    forbidden: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(forbidden.parent)
    Path("image.png").touch()
    sections, message = WAYS[way]
    _hostile(content, Path(), **sections)
    with watched(forbidden) as happened, pytest.raises(SystemExit) as raised:
        _run(monkeypatch, command, *COMMANDS[command])
    assert re.search(rf"last\.ckpt: found (config\.)?{message}", str(raised.value))
    assert "Traceback" not in capsys.readouterr().err
    assert not happened


@pytest.mark.parametrize("way", WAYS)
def test_a_start_from_tensors_reads_tensors_only(
    way: str, content: dict[str, Any], forbidden: Path
) -> None:
    path = _hostile(content, forbidden.parent, **WAYS[way][0])
    with watched(forbidden) as happened:
        network = make(_UNET, "network")
        assert initialize(network, path).share == 1
        assert inputs_in(path) == ("rgb",)
    assert not happened


@pytest.mark.parametrize("way", WAYS)
def test_a_transfer_compares_and_makes_nothing(
    way: str, content: dict[str, Any], forbidden: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(forbidden.parent)
    _hostile(content, Path(), **WAYS[way][0])
    given = ["experiment=rooms/transfer", "checkpoint=run/checkpoints/last.ckpt"]
    with watched(forbidden) as happened, pytest.raises(SystemExit, match=r"last\.ckpt: found"):
        _run(monkeypatch, "transfer", *given)
    assert not happened


def test_a_checkpoint_whose_config_is_a_text(
    content: dict[str, Any], forbidden: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(forbidden.parent)
    Path("image.png").touch()
    path = _hostile(content, Path())
    text = f"network: {{_target_: {_FIRE}}}\nlevel: 4\nseed: 0\n"
    torch.save(content | {"config": text}, path)
    for command, arguments in COMMANDS.items():
        with (
            watched(forbidden) as happened,
            pytest.raises(SystemExit, match=r"last\.ckpt: found c"),
        ):
            _run(monkeypatch, command, *arguments)
        assert not happened


def test_references_evade_no_rule_about_a_place(content: dict[str, Any], forbidden: Path) -> None:
    """What compiles is this machine's: of a file it is not even looked at."""
    options = {"options": {"cpp.cxx": f"sh -c 'id > {forbidden}/x'"}}
    for compiling in (options, "${bag}", "inductor"):
        task = content["config"]["task"] | {"compile": compiling}
        path = _hostile(content, forbidden.parent, task=task, bag=options)
        with watched(forbidden) as happened:
            settings, _ = _settled(path)
        assert "compile" not in settings["task"]
        assert not happened
    settings, _ = _settled(path, "task.compile={mode: max-autotune}")
    assert settings["task"]["compile"] == {"mode": "max-autotune"}


def test_paths_are_not_taken_from_files(content: dict[str, Any], forbidden: Path) -> None:
    data = content["config"]["data"]
    path = _hostile(content, forbidden.parent, data=data | {"root": str(forbidden), "store": "/x"})
    settings, _ = _settled(path, root="mine")
    assert settings["data"]["root"] == "mine"
    assert "store" not in settings["data"]
    with pytest.raises(SettingError, match=r"data\.root: found .*The run had data\.root="):
        _settled(path, root=None)


def test_paths_of_ones_own_configs_need_not_be_typed_again(
    content: dict[str, Any], tmp_path: Path
) -> None:
    """The experiment of the run says the same here."""
    data = content["config"]["data"] | {"root": "data/rooms_demo"}
    path = _hostile(content, tmp_path, data=data)
    assert _settled(path, root=None)[0]["data"]["root"] == "data/rooms_demo"


def test_options_of_the_run_are_looked_up_among_ones_own(
    content: dict[str, Any], forbidden: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A name of an option is no path to somebody's config."""
    monkeypatch.chdir(forbidden.parent)
    (forbidden / "data").mkdir()
    target = content["config"]["data"]["_target_"]
    theirs = f"# @package data\n_target_: {target}\nroot: rooms\nstore: x_${{oc.env:SECRET}}\n"
    (forbidden / "data" / "z.yaml").write_text(theirs)
    up = "/".join([".."] * 30)
    for option in (f"{up}{forbidden}/data/z", "../data/folder", "a\0b/c", "z"):
        for group in ("data", "experiment", "trainer"):
            path = _hostile(content, Path(), choices={group: option})
            with watched(forbidden) as happened:
                try:
                    settings, _ = _settled(path)
                except DataError as error:
                    assert "choices" in str(error)  # noqa: PT017 - either is right
                else:
                    assert "store" not in settings["data"]
            assert not [event for event in happened if "z.yaml" in event]


def test_files_decide_no_processes_and_no_sockets(content: dict[str, Any], tmp_path: Path) -> None:
    many = {"devices": 3, "strategy": "ddp", "num_nodes": 2, "accelerator": "gpu"}
    trainer = content["config"]["trainer"] | many | {"model_registry": "x", "max_time": "00:01:00"}
    settings, _ = _settled(_hostile(content, tmp_path, trainer=trainer))
    assert not {*many, "model_registry", "max_time"} & settings["trainer"].keys() - {
        "accelerator", "devices"}  # fmt: skip
    assert settings["trainer"].get("devices") != 3
    assert settings["trainer"].get("accelerator") != "gpu"


@pytest.mark.parametrize("name", ["..", "../..", "/", ".", "notes.txt", "/etc/passwd"])
def test_where_the_best_epoch_is_does_not_come_out_of_a_file(name: str, tmp_path: Path) -> None:
    """Lightning removes the one that was the best before: once the whole folder, by its state."""
    best = best_checkpoint(tmp_path)
    low = torch.tensor(-1.0)
    state = dict.fromkeys(("best_model_path", "kth_best_model_path", "last_model_path"), name)
    scores = dict.fromkeys(("best_model_score", "current_score", "kth_value"), low)
    best.load_state_dict({**state, **scores, "best_k_models": {name: low}, "dirpath": "/"})
    mine = str(tmp_path / "best.ckpt")
    assert best.dirpath == str(tmp_path)
    assert {best.best_model_path, best.kth_best_model_path, *best.best_k_models} == {mine}
    assert best.last_model_path == ""
    assert best.best_model_score == -1


def test_checkpoints_are_files_when_they_are_removed(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    with pytest.raises(OSError, match="folder"):
        AtomicCheckpointIO().remove_checkpoint(tmp_path / "folder")
    (tmp_path / "x.ckpt").touch()
    AtomicCheckpointIO().remove_checkpoint(tmp_path / "x.ckpt")
    assert [path.name for path in tmp_path.iterdir()] == ["folder"]


@pytest.mark.parametrize(
    ("entry", "value"),
    [
        ("callbacks", "x"),
        ("optimizer_states", "x"),
        ("optimizer_states", [{"state": {}, "param_groups": "x"}]),
    ],
)
def test_what_cannot_be_gone_on_with_is_said_in_a_line(
    entry: str,
    value: Any,
    run: Path,
    content: dict[str, Any],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(run.parent)
    theirs = tmp_path / "theirs"
    (theirs / "checkpoints").mkdir(parents=True)
    torch.save(content | {entry: value}, theirs / "checkpoints" / "last.ckpt")
    with pytest.raises(
        SystemExit, match=r"^tangent-train: .*last\.ckpt: found what cannot be gone"
    ):
        _run(monkeypatch, "train", f"resume={theirs}", "data.root=rooms")


def test_terminals_get_no_commands(content: dict[str, Any], run: Path, tmp_path: Path) -> None:
    evil = "a.b\x1b]0;owned\x07\n\x1b[31mtrust me"
    path = _hostile(content, tmp_path, network={"_target_": evil})
    with pytest.raises(DataError) as refused:
        load_trained(path)
    assert "\x1b" not in str(refused.value)
    torch.save(content | {"class_names": [evil] * 14}, path)
    with pytest.raises(DataError, match="class_names="):
        load_trained(path)
    settings = read_settings(run / "config.yaml") | {"name": evil}
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(settings))
    with pytest.raises(DataError, match=r"settings\.name="):
        read_settings(tmp_path / "config.yaml")
    network = make(_UNET, "network")
    names = {"[/nope][link=x]" + evil: torch.zeros(1), **network.state_dict()}
    torch.save(names, path)
    console = Console(record=True, width=200, force_terminal=True)
    console.print(str(initialize(network, path)), markup=False)
    shown = console.export_text()
    assert "[/nope][link=x]a.b" in shown
    assert "\x07" not in shown


def test_networks_are_one_file(run: Path, tmp_path: Path) -> None:
    model = onnx.load(run.parent / "net.onnx")
    tensor = model.graph.initializer[0]
    onnx.external_data_helper.set_external_data(tensor, "/etc/hostname")
    tensor.ClearField("raw_data")
    (tmp_path / "x.onnx").write_bytes(model.SerializeToString())
    with pytest.raises(DataError, match=r"x\.onnx: found tensors in other files"):
        load_trained(tmp_path / "x.onnx")


def test_names_of_classes_are_names(
    forbidden: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A data set's classes.json, through training and evaluation."""
    monkeypatch.chdir(forbidden.parent)
    names = [
        f"${{oc.create:{{_target_: {_FIRE}, command: 'id > {forbidden}/x'}}}}",
        "${oc.env:SECRET}",
        "=HYPERLINK(1)",
        f"{{_target_: {_FIRE}}}",
    ]
    write_data_set(Path("theirs"), height=64)
    write_classes(Path("theirs"), dict(zip(names, (1, [2, 3], 255, 4), strict=True)))
    folder = ["data=folder", "data.root=theirs", "data.inputs=[rgb]", "data.num_workers=0"]
    own = [s for s in SETTINGS if not s.startswith(("experiment", "data", "representation"))]
    widths = ["network=unet_small", "representation=tangent_economy_16", *own, "level=5"]
    with watched(forbidden) as happened:
        _run(monkeypatch, "check", *folder, "level=5")
        _run(monkeypatch, "train", *widths, *folder, "hydra.run.dir=run")
        best = "checkpoint=run/checkpoints/last.ckpt"
        _run(monkeypatch, "evaluate", best, "data.root=theirs", "hydra.run.dir=evaluated")
        images = next(Path("theirs/images").rglob("*.png"))
        _run(monkeypatch, "predict", best, f"input={images}", "output=labels", "device=cpu")
        _run(monkeypatch, "report", "run", "evaluated", "--output", "report")
    assert not happened
    for file in (Path("run/results.csv"), Path("evaluated/results.csv")):
        with file.open() as opened:
            found = [row["class"] for row in csv.DictReader(opened)]
        assert found == [f"'{n}" if n.startswith("=") else n for n in names]
    written = [p for top in ("run", "evaluated", "labels", "report") for p in Path(top).rglob("*")]
    for path in written:
        assert not path.is_file() or SECRET.encode() not in path.read_bytes(), path
    assert SECRET not in capsys.readouterr().out


def test_reports_of_other_peoples_runs_look_nothing_up(
    run: Path, forbidden: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(forbidden.parent)
    settings = read_settings(run / "config.yaml")
    settings |= {"c": "env", "name": "${oc.${c}:SECRET}"}
    settings["data"] |= {"inputs": "${oc.env:SECRET}", "fold": "${oc.${c}:SECRET}"}
    Path("theirs").mkdir()
    shutil.copy(run / "results.json", "theirs")
    Path("theirs/config.yaml").write_text(yaml.safe_dump(settings))
    with pytest.raises(SystemExit, match=r"config\.yaml: found data\.fold=.* inside; expected"):
        _run(monkeypatch, "report", "theirs", "--output", "report")
    settings["data"] |= {"inputs": ["rgb"], "fold": 1}
    Path("theirs/config.yaml").write_text(yaml.safe_dump(settings))
    _run(monkeypatch, "report", "theirs", "--output", "report")
    said = capsys.readouterr()
    assert SECRET not in said.out + said.err
    for path in Path("report").iterdir():
        assert SECRET.encode() not in path.read_bytes(), path


def test_aliases_in_settings_are_not_followed(tmp_path: Path) -> None:
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x]"]
    lines += [f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 9)}]" for k in range(1, 12)]
    (tmp_path / "config.yaml").write_text("\n".join(lines))
    with pytest.raises(DataError, match=r"config\.yaml: found an alias"):
        read_settings(tmp_path / "config.yaml")
    (tmp_path / "config.yaml").write_text("x: " + "[" * 1500 + "]" * 1500)
    with pytest.raises(DataError, match=r"config\.yaml: found RecursionError"):
        read_settings(tmp_path / "config.yaml")


class Saving(nn.Module):
    """Writes a file when it is used."""

    def __init__(self, path: str) -> None:
        super().__init__()
        self.path = path

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        torch.save(images, self.path)
        return images


@pytest.mark.parametrize("order", ["program", "program first", "program last"])
def test_programs_of_torchscript_are_refused(
    order: str, run: Path, content: dict[str, Any], forbidden: Path
) -> None:
    """Also in a file that holds two archives, of which two readers may find two."""
    path = forbidden.parent / "x.pt"
    torch_script: Any = torch.jit
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch_script.save(torch_script.script(Saving(str(forbidden / "x"))), str(path))
    program = path.read_bytes()
    torch.save(content, path)
    honest = path.read_bytes()
    parts = {"program": [program], "program first": [program, honest]}
    path.write_bytes(b"".join(parts.get(order, [honest, program])))
    refused = pytest.raises(DataError, match=r"a TorchScript program|archive is corrupted")
    with watched(forbidden) as happened, refused:
        load_trained(path)
    assert not happened
    assert not (forbidden / "x").exists()


class Own(nn.Conv2d):
    """A network of a user."""

    def __init__(self, in_channels: int, num_classes: int, inner: Any = None) -> None:
        super().__init__(in_channels, num_classes, 1)


OWN = f"{__name__}.Own"


def _own(content: dict[str, Any], path: Path, **settings: Any) -> Path:
    network = {"_target_": OWN, "in_channels": 3, "num_classes": 14, **settings}
    tensors = {f"network.{n}": t for n, t in Own(3, 14).state_dict().items()}
    changed = content | {"config": content["config"] | {"network": network}}
    torch.save(changed | {"state_dict": tensors}, path)
    return path


def test_ones_own_network_is_trusted_by_its_name(content: dict[str, Any], tmp_path: Path) -> None:
    path = _own(content, tmp_path / "x.ckpt")
    with pytest.raises(DataError, match=f"trust={OWN}"):
        load_trained(path)
    assert load_trained(path, [OWN]).in_channels == 3
    for said in (f"trust={OWN}", f"trust=['{OWN}',my.Other]", f"network._target_={OWN}"):
        settings, trust = _settled(path, said)
        assert OWN in trust
        build(settings, trust)
    with pytest.raises(DataError, match=f"trust={OWN}"):
        _settled(path, "trust=my.Other")
    # What it is given may be any plain value, but objects inside are checked all the same.
    path = _own(content, tmp_path / "x.ckpt", inner={"a": [{"_target_": _FIRE}]})
    with pytest.raises(DataError, match=rf"network\.inner\.a\.0\._target_={_FIRE}"):
        load_trained(path, [OWN])


def test_trust_reaches_every_command(
    content: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    _own(content, Path("x.ckpt"))
    line = ["checkpoint=x.ckpt", "output=x.safetensors"]
    with pytest.raises(SystemExit, match="trust: found 3; expected a name, or a list of names"):
        _run(monkeypatch, "export", *line, "trust=3")
    _run(monkeypatch, "export", *line, f"trust={OWN}")
    with pytest.raises(DataError, match=f"trust={OWN}"):
        load_trained(Path("x.safetensors"))
    assert load_trained(Path("x.safetensors"), [OWN]).trust == (OWN,)


def test_all_that_the_configs_name_is_registered() -> None:
    for path in sorted(config_folder().rglob("*.yaml")):
        for target in named_targets(yaml.safe_load(path.read_text())):
            if target.endswith("Pairs"):  # of tangent-keypoints, which leaves no checkpoint
                continue
            assert registry._find(target, ())[0] is not None, (path, target)


MACHINE = {"root", "store", "label_table", "compile"}
MACHINE |= {"accelerator", "devices", "num_nodes", "strategy"}
EXPERIMENTS = sorted(
    p.relative_to(config_folder() / "experiment").with_suffix("").as_posix()
    for p in (config_folder() / "experiment").rglob("*.yaml")
)
OPTIONS = [
    f"{group}={path.stem}"
    for group in ("data", "network", "representation", "optimizer", "scheduler", "trainer")
    for path in sorted((config_folder() / group).glob("*.yaml"))
    if not path.stem.endswith("pairs")
]


@pytest.mark.parametrize("option", [f"experiment={name}" for name in EXPERIMENTS] + OPTIONS)
def test_settings_of_every_experiment_and_option_are_accepted(option: str, tmp_path: Path) -> None:
    """As a checkpoint has them, but for what is of this machine."""
    command = "transfer" if "transfer" in option else "train"
    with initialize_config_dir(str(config_folder()), version_base="1.3"):
        config: Any = OmegaConf.to_container(compose(command, [option]), resolve=True)
    network = completed_settings(config["network"], 3, 14)
    sections = {name: config[name] for name in ("data", "representation", "optimizer", "trainer")}
    sections |= {"network": network, "task": config["task"], "scheduler": config["scheduler"]}
    for photos in (config.get("photos", {}),):
        sections |= {f"photos.{name}": section for name, section in photos.items()}
    accepted = accept(tmp_path, sections)
    weights = {"weights", "weights_backbone", "encoder_weights"}
    for name, section in sections.items():
        left_out = {key for key in section if key not in accepted.settings[name]} - weights
        assert left_out <= MACHINE
        for key, value in accepted.settings[name].items():
            assert isinstance(value, dict) or key in weights or value == section[key]


@pytest.mark.parametrize(
    "network",
    [
        {"_target_": "torch.nn.Conv2d", "in_channels": 3, "out_channels": 14, "kernel_size": 1},
        {"_target_": "torchvision.models.segmentation.fcn_resnet50", "num_classes": 14},
        {"_target_": "segmentation_models_pytorch.FPN", "encoder_name": "tu-convnext_atto"},
        {"_target_": "timm.create_model", "model_name": "resnet18.a1_in1k", "pretrained": True},
    ],
)
def test_networks_of_the_libraries_need_no_trust_and_fetch_nothing(
    network: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("socket.getaddrinfo", _no_network)
    settings = accept(tmp_path, {"network": network}).settings["network"]
    with watched(tmp_path / "forbidden") as happened:
        make(settings, "network", ())
    assert not happened


def test_what_networks_are_shown_is_said_alike_in_both_places() -> None:
    assert list[Input] == INPUTS


def test_tensors_are_tensors(content: dict[str, Any], tmp_path: Path) -> None:
    path = tmp_path / "x.ckpt"
    for wrong in ({"network.x": "y"}, {"network.x": [1]}, "text", None):
        torch.save(content | {"state_dict": wrong}, path)
        with pytest.raises(DataError, match=r"x\.ckpt: found"):
            load_trained(path)
    torch.save(content, path)
    assert read_checkpoint(path)["kind"] == "segmentation"
