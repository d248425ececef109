"""A finished run, whose files are then changed as somebody hostile would."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from tangent_train.cli.compose import config_folder, quote_path
from tangent_train.cli.stored import StoredRun, stored_run
from tangent_train.registry import SettingsFile

__all__ = ["SECRET", "SETTINGS", "composed", "settled", "with_config"]

SECRET = "sesame-open"
SETTINGS = (
    "experiment=rooms/demo",
    "level=4",
    "network.widths=[4,8]",
    "representation.crop_multiple=null",
    "data.panoramas_per_step=1",
    "data.validation_fraction=0.2",
    "data.inputs=[rgb]",
    "data.rooms.height=32",
    *(f"data.rooms.rooms.area_{a}={n}" for a, n in zip("1234", (2, 1, 1, 1), strict=True)),
    *(f"data.rooms.rooms.area_{a}=1" for a in ("5a", "5b", "6")),
    "trainer.accelerator=cpu",
    "trainer.max_epochs=1",
    "panels=0",
    "tensorboard_images=0",
)


def composed(arguments: list[str]) -> dict[str, Any]:
    """The settings that Hydra composes from the command line of tangent-evaluate."""
    with initialize_config_dir(str(config_folder()), version_base="1.3"):
        config = compose("evaluate", [quote_path(argument) for argument in arguments])
    plain: Any = OmegaConf.to_container(config, resolve=True)
    return dict(plain)


def settled(
    path: Path, *said: str, root: str | None = "rooms"
) -> tuple[dict[str, Any], SettingsFile]:
    """The settings of ``tangent-evaluate checkpoint=<path> …``, and where they come from."""
    typed = [*said, *([] if root is None else [f"data.root={root}"])]
    stored = stored_run("evaluate", [f"checkpoint={path}", *typed])
    assert isinstance(stored, StoredRun)
    return stored.settings(composed(stored.arguments))


def with_config(content: dict[str, Any], folder: Path, **sections: Any) -> Path:
    """A run folder whose checkpoint has other settings."""
    path = folder / "run" / "checkpoints" / "last.ckpt"
    path.parent.mkdir(parents=True, exist_ok=True)
    torch.save(content | {"config": content["config"] | sections}, path)
    return path
