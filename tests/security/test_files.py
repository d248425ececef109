"""Hostile networks through every command and function that takes a network from a file."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import tangent_train as tt
from tangent_train.checkpoints.loaded import METADATA_KEY
from tangent_train.errors import DataError
from tangent_train.io.pixel_files import write_pixels
from tests.cli.tiny_runs import run_command
from tests.inference.trained import write_checkpoint
from tests.security.watch import watched

EVIL = {"_target_": "os.system", "command": "touch forbidden/x"}


class Unpickled:
    """Creates a folder when it is unpickled."""

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, ("forbidden/x",)


def _in(name: str, value: Any) -> Callable[[dict[str, Any]], None]:
    def change(content: dict[str, Any]) -> None:
        content[METADATA_KEY][name] = value

    return change


def _in_network(**more: Any) -> Callable[[dict[str, Any]], None]:
    def change(content: dict[str, Any]) -> None:
        content[METADATA_KEY]["settings"] |= more

    return change


def _pickled(content: dict[str, Any]) -> None:
    content["callbacks"] = Unpickled()


ATTACKS = {
    "network": _in("settings", EVIL),
    "inside the network": _in_network(bias=EVIL),
    "interpolation": _in_network(padding_mode="${oc.env:SECRET}"),
    "address": _in_network(padding_mode="https://localhost/x"),
    "representation": _in("representation", EVIL),
    "pickle": _pickled,
}


@pytest.mark.parametrize("attack", ATTACKS)
def test_nothing_runs_and_nothing_is_contacted(
    attack: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("SECRET", "secret")
    Path("forbidden").mkdir()
    content = torch.load(write_checkpoint(tmp_path / "honest.ckpt"), weights_only=True)
    ATTACKS[attack](content)
    torch.save(content, "hostile.ckpt")
    write_pixels(tmp_path / "in" / "a.png", np.zeros((32, 64, 3), np.uint8))
    data = "data=synthrooms", "data.root=rooms"
    commands = {
        "evaluate": ("checkpoint=hostile.ckpt", *data),
        "export": ("checkpoint=hostile.ckpt", "output=out.onnx"),
        "predict": ("checkpoint=hostile.ckpt", "input=in", "output=out"),
        "train": ("init_from=hostile.ckpt", *data, "data.inputs=[rgb]"),
    }
    with watched(tmp_path / "forbidden") as happened:
        with pytest.raises(DataError, match=r"hostile\.ckpt"):
            tt.load("hostile.ckpt")
        for command, arguments in commands.items():
            if (command, attack) != ("train", "representation"):  # of the config, not of the file
                with pytest.raises(SystemExit, match=r"hostile\.ckpt"):
                    run_command(monkeypatch, command, *arguments)
    assert happened == []
    assert not list(Path("forbidden").iterdir())
