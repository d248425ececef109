"""Hostile files, through every command that takes such a file."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml  # type: ignore[import-untyped]
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from tangent_train.checkpoints.loaded import METADATA_KEY
from tangent_train.rendering import TangentRepresentation
from tests.cli.tiny_runs import run_command
from tests.models.onnx_files import write_linear
from tests.security.attacks import CANARY
from tests.security.honest import SETTINGS
from tests.security.watch import watched

_COMMAND = {"_target_": f"{CANARY}.fire"}
_GPT2 = {"model_type": "timm_backbone", "backbone": "gpt2"}
_SAM = {"model_type": "sam3", "vision_config": _GPT2}
_HUGGINGFACE = (
    ({"model_type": "upernet", "backbone_config": _GPT2}, "Unknown model (gpt2)"),
    ({"model_type": "upernet", "backbone_config": _SAM}, "network"),
    ({"model_type": CANARY, "auto_map": {"AutoConfig": f"{CANARY}.C"}}, "network.config"),
)
"""Configs of transformers that ask for something on the hub."""

_WITHOUT_NETWORK = [message for message in SETTINGS if not message.startswith("network")]
_CHECKPOINT = "theirs/checkpoints/last.ckpt"

Use = Callable[..., None]
"""Runs a command with arguments."""


@pytest.fixture
def use(run: Path, forbidden: Path, monkeypatch: pytest.MonkeyPatch) -> Use:
    """Run a command beside the folder ``theirs``: it must refuse that in a line, and do nothing."""
    monkeypatch.chdir(forbidden.parent)
    Path("rooms").symlink_to(run.parent / "rooms")

    def refused(found: str, command: str, *arguments: str) -> None:
        with watched(forbidden) as happened, pytest.raises(SystemExit) as ended:
            run_command(monkeypatch, command, *arguments)
        assert happened == []
        message = str(ended.value)
        assert message.startswith(f"tangent-{command}: ")
        assert "theirs" in message or "network.config" in message
        assert found in message
        assert "\n" not in message

    return refused


def _attack(config: dict[str, Any]) -> dict[str, Any]:
    """A section that would be called, and a name with a dot for the same place."""
    data = config["data"] | {"mask": _COMMAND}
    return config | {"data": data, "data.mask": "x"}


def _plain_attack(config: dict[str, Any]) -> dict[str, Any]:
    """The same at two places, of which commands without data read the second one."""
    network = config["network"] | {"widths": [_COMMAND]}
    return config | {"data": config["data"] | {"mask": _COMMAND}, "network": network}


@pytest.mark.parametrize(
    ("command", "arguments"),
    [
        ("evaluate", (f"checkpoint={_CHECKPOINT}", "data.root=rooms")),
        ("train", ("resume=theirs", "data.root=rooms")),
        ("train", (*_WITHOUT_NETWORK, f"init_from={_CHECKPOINT}", "data.root=rooms")),
        ("predict", (f"checkpoint={_CHECKPOINT}", "input=rooms", "output=labels")),
        ("export", (f"checkpoint={_CHECKPOINT}", "output=net.safetensors")),
        ("transfer", (f"checkpoint={_CHECKPOINT}", "data.root=rooms", "folds=[1]")),
    ],
)
def test_hostile_checkpoints_are_refused(
    command: str, arguments: tuple[str, ...], content: dict[str, Any], use: Use
) -> None:
    Path(_CHECKPOINT).parent.mkdir(parents=True)
    torch.save(content | {"config": _attack(content["config"])}, _CHECKPOINT)
    use("the name 'data.mask' in config; expected", command, *arguments)
    if command == "transfer":  # reads nothing more but the tensors and the fold
        return
    torch.save(content | {"config": _plain_attack(content["config"])}, _CHECKPOINT)
    use(f"{{'_target_': '{CANARY}.fire'}}", command, *arguments)
    for config, found in _HUGGINGFACE:
        network = {"_target_": "models.HuggingFaceNetwork", "config": config, "num_classes": 13}
        torch.save(content | {"config": content["config"] | {"network": network}}, _CHECKPOINT)
        use(found, command, *arguments)


def noted(note: str, **settings: Any) -> TangentRepresentation:
    """A representation that the user defines."""
    del note
    return TangentRepresentation(**settings)


def test_a_transfer_interpolates_nothing_of_a_file(run: Path, use: Use) -> None:
    """Its stages are configs; here with a class that the user trusts."""
    with safe_open(run.parent / "net.safetensors", "pt") as file:
        described = json.loads(file.metadata()[METADATA_KEY])
    section = {
        "_target_": f"{__name__}.noted",
        "note": f"${{oc.create:{{_target_: {CANARY}.fire}}}}",
    }
    described["representation"] |= section
    text = json.dumps(described)
    save_file(load_file(run.parent / "net.safetensors"), "theirs.safetensors", {METADATA_KEY: text})
    arguments = ("checkpoint=theirs.safetensors", "data.root=rooms", f"trust={__name__}.noted")
    use("expected no ${…}: settings", "transfer", *arguments)


def test_hostile_results_are_refused(run: Path, use: Use) -> None:
    shutil.copytree(run, "theirs", ignore=shutil.ignore_patterns("checkpoints", "tensorboard"))
    settings = Path("theirs/config.yaml").read_text()
    Path("theirs/config.yaml").write_text(yaml.safe_dump(_attack(yaml.safe_load(settings))))
    use("the name 'data.mask' in settings", "report", "theirs")
    Path("theirs/config.yaml").write_text(f"{settings}\ndata: {{_target_: {CANARY}.fire}}\n")
    use("a repeated name among", "report", "theirs")
    Path("theirs/config.yaml").write_text(settings)
    results = Path("theirs/results.json").read_text()
    Path("theirs/results.json").write_text(results.replace("{", '{"classes": [], ', 1))
    use("'classes' is repeated", "report", "theirs")


def test_results_of_keypoints(use: Use, run: Path) -> None:
    pytest.importorskip("pycolmap")
    panorama = next((run.parent / "rooms").rglob("*equirectangular_domain_rgb.png"))
    Path("theirs").mkdir()
    Path("theirs/results.json").write_text('{"settings": {}, "rows": [], "rows": [{"pair": "a"}]}')
    pair = (f"left={panorama}", f"right={panorama}")
    use("'rows' is repeated", "keypoints", *pair, "output=theirs", "base_level=[0]", "level=5")


@pytest.mark.parametrize("network", ["huggingface", "smp", "onnx"])
def test_networks_of_other_libraries(network: str, use: Use) -> None:
    Path("theirs").mkdir()
    for name in ("config.json", "classes.json"):
        Path("theirs", name).write_text('{"0": "wall", "0": "floor"}')
    given = ("classes=theirs/classes.json", "normalization=imagenet")
    source = "model=theirs" if network != "onnx" else "file=net.onnx"
    suffix = "onnx" if network == "onnx" else "ckpt"
    write_linear(Path("net.onnx"), np.zeros((2, 3), np.float32), np.zeros(2, np.float32))
    arguments = (f"network={network}", source, *given, f"output=ours.{suffix}")
    use("'0' is repeated", "import", *arguments)
    if network == "huggingface":
        labels = {"id2label": {"0": "wall", "1": "floor"}}
        for config, found in _HUGGINGFACE:
            Path("theirs/config.json").write_text(json.dumps(config | labels))
            Path("theirs/preprocessor_config.json").write_text("{}")
            use(found, "import", *arguments)
