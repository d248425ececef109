"""Configs of the tree, composed as commands do, and Python in a process of its own."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

from hydra import compose, initialize_config_dir
from omegaconf import DictConfig, OmegaConf

from tangent_train.cli.compose import config_folder

ROOT = Path(__file__).resolve().parents[1]


def composed(command: str, *overrides: str, **more: Any) -> DictConfig:
    """The config of a command line; `more` for Hydra's `compose`."""
    with initialize_config_dir(str(config_folder()), version_base="1.3"):
        return compose(command, list(overrides), **more)


def composed_settings(command: str, *overrides: str) -> dict[str, Any]:
    """Likewise, as plain values."""
    settings: Any = OmegaConf.to_container(composed(command, *overrides), resolve=True)
    return dict(settings)


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
