"""An honest run, and a folder that only attacks name."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch

from tests.cli.tiny_runs import run_command
from tests.security.honest import SECRET, SETTINGS


@pytest.fixture(scope="session")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a finished run; beside it its data and the network as other files."""
    folder = tmp_path_factory.mktemp("honest")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        run_command(patch, "train", *SETTINGS, "data.root=rooms", "hydra.run.dir=run")
        checkpoint = "checkpoint=run/checkpoints/last.ckpt"
        for name in ("net.onnx", "net.safetensors"):
            run_command(patch, "export", checkpoint, f"output={name}")
    return folder / "run"


@pytest.fixture(scope="session")
def content(run: Path) -> dict[str, Any]:
    """The content of its checkpoint."""
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
