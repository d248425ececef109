"""Settings of runs of a second, and commands in this process."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tangent_train.cli import main

Run = Callable[..., None]
"""Runs a command with arguments."""

Predict = Callable[..., dict[str, Any]]
"""Runs ``tangent-predict`` with settings; gives the entries of its summary by name."""

_ROOMS = {"1": 2, "2": 2, "3": 1, "4": 1, "5a": 1, "5b": 1, "6": 1}
SMALL_ROOMS = (
    "level=4",
    "data.batch_size=2",
    "data.val_fraction=0.2",
    "data.rooms.height=32",
    *(f"data.rooms.rooms.area_{area}={n}" for area, n in _ROOMS.items()),
    "trainer.accelerator=cpu",
)
SETTINGS = (
    "experiment=rooms/demo",
    *SMALL_ROOMS,
    "representation.crop_multiple=null",
    "network.widths=[4,8]",
    "trainer.max_epochs=2",
    "trainer.check_val_every_n_epoch=1",
    "panels=1",
)


def run_command(monkeypatch: pytest.MonkeyPatch, command: str, *arguments: str) -> None:
    """Run a command in this process."""
    monkeypatch.setattr(sys, "argv", [f"tangent-{command}", *arguments])
    getattr(main, command.replace("import", "import_network"))()


def run_in(folder: Path, command: str, *arguments: str) -> None:
    """Run a command in a folder, for fixtures that several tests share."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        run_command(patch, command, *arguments)


def results(folder: Path) -> dict[str, Any]:
    """The ``results.json`` of a run, without the place of its network."""
    content: dict[str, Any] = json.loads((folder / "results.json").read_text())
    content.pop("checkpoint", None)
    return content


def predicted(folder: Path) -> dict[str, Any]:
    """Return the entries of a ``summary.json`` by name; empty without the file."""
    path = folder / "summary.json"
    images = json.loads(path.read_text())["images"] if path.exists() else []
    return {entry["name"]: entry for entry in images}
