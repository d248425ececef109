"""Attacks at the places of a checkpoint, through all that reads one."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import torch

from tangent_train.checkpoints.trained import load_trained, start_in
from tangent_train.cli.build import build
from tangent_train.cli.stored import StoredRun, stored_run
from tangent_train.errors import DataError, SettingError
from tangent_train.registry import make
from tests.security.attacks import attacks, places, replaced, sampled
from tests.security.honest import composed
from tests.security.watch import watched

__all__ = ["attack_checkpoints", "nothing_happens"]


def nothing_happens(use: Callable[[Path], Any], path: Path, forbidden: Path, what: object) -> None:
    """Use a file: it is taken for what it is, or refused in one line that names it."""
    with watched(forbidden) as happened, suppress(DataError, SettingError):
        use(path)
    assert not happened, (what, happened)
    assert [path.name for path in forbidden.iterdir()] == ["config.json"], what


def attack_checkpoints(content: dict[str, Any], forbidden: Path) -> None:
    """Put every attack into a checkpoint, and an attack at every place of it.

    Args:
        content: Of an honest one.
        forbidden: A folder that exists and nobody else names.
    """
    honest, path = forbidden.parent / "honest.ckpt", forbidden.parent / "x.ckpt"
    torch.save(content, honest)
    stored = stored_run("evaluate", [f"checkpoint={honest}", "data.root=rooms"])
    assert isinstance(stored, StoredRun)
    said = composed(stored.arguments)

    def evaluated(path: Path) -> None:
        stored = stored_run("evaluate", [f"checkpoint={path}", "data.root=rooms"])
        assert isinstance(stored, StoredRun)
        settings, source = stored.settings(said)
        build(settings, source)
        make(settings["trainer"], "trainer", source, logger=False)

    lighter = content | {"optimizer_states": [], "loops": {}}
    all_places = [("config", *place) for place in places(content["config"])]
    all_places += [(name,) for name in ("config", "class_names", "inputs", "kind", "state_dict")]
    all_places += [("normalization",), ("normalization", "mean")]
    for place, value in sampled(list(attacks(forbidden)), all_places):
        torch.save(replaced(lighter, place, value), path)
        for use in (load_trained, evaluated, start_in):
            nothing_happens(use, path, forbidden, (place, value))
