"""Configs of the tree, composed as commands do, and Python in a process of its own."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from hydra import compose, initialize_config_dir
from omegaconf import DictConfig

from tangent_train.config.settings import config_name, validate
from tangent_train.files import config_folder

Capture = pytest.CaptureFixture[str]
Patch = pytest.MonkeyPatch
ROOT = Path(__file__).resolve().parents[1]


def composed(command: str, *overrides: str, **more: Any) -> DictConfig:
    """The config of a command line; `more` for Hydra's `compose`."""
    config_name(command, ())
    with initialize_config_dir(str(config_folder()), version_base="1.3"):
        return compose(command, list(overrides), **more)


def composed_settings(command: str, *overrides: str) -> Any:
    """The settings of a command line."""
    return validate(command, composed(command, *overrides))


def run_python(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run a program in a folder, with the modules of this checkout; what it prints is kept."""
    return subprocess.run(
        [sys.executable, *arguments],
        check=False,
        cwd=folder,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
    )


def command_of(experiment: str) -> str:
    """Return the command that an experiment is for, transfer or train."""
    pairs = "transfer", "zero_shot", "field/cityscapes_densepass", "field/stanford2d3ds_span8"
    return "transfer" if any(name in experiment for name in pairs) else "train"
