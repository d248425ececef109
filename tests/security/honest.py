"""A finished run, whose files are then changed as somebody hostile would."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from tangent_train.cli.compose import literal_paths
from tangent_train.cli.stored import StoredRun, stored_run
from tangent_train.config.build import SettingsFile
from tests.cli import tiny_runs
from tests.running import composed_settings

SECRET = "sesame-open"
SETTINGS = (
    *tiny_runs.SETTINGS,
    "data.inputs=[rgb]",
    "trainer.max_epochs=1",
    "panels=0",
    "validation_images=0",
)


def composed(arguments: list[str]) -> dict[str, Any]:
    """The settings that Hydra composes from the command line of tangent-evaluate."""
    return composed_settings("evaluate", *literal_paths("evaluate", arguments))


def settled(
    path: Path, *overrides: str, root: str | None = "rooms"
) -> tuple[dict[str, Any], SettingsFile]:
    """The settings of ``tangent-evaluate checkpoint=<path> …``, and where they come from."""
    typed = [*overrides, *([] if root is None else [f"data.root={root}"])]
    stored = stored_run("evaluate", [f"checkpoint={path}", *typed])
    assert isinstance(stored, StoredRun)
    return stored.settings(composed(stored.arguments))


def with_config(content: dict[str, Any], folder: Path, **sections: Any) -> Path:
    """A run folder whose checkpoint has other settings."""
    path = folder / "run" / "checkpoints" / "last.ckpt"
    path.parent.mkdir(parents=True, exist_ok=True)
    torch.save(content | {"config": content["config"] | sections}, path)
    return path
