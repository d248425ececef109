"""Folders of made data: marked with their settings; what is someone else's is left alone."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

from tangent_train.errors import DataError
from tangent_train.files import write_text
from tangent_train.json_text import parse_json

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

__all__ = ["claim_folder"]


def claim_folder(
    root: Path, manifest: str, generator: str, version: int, settings: Mapping[str, Any]
) -> None:
    """Make sure that a folder is ours to write to, and mark it.

    Args:
        root: Folder of the data set: new, empty, or of the same settings.
        manifest: Name of the file in it that marks it and holds the settings.
        generator: Name of what makes the data.
        version: Its version; another one makes other files from the same settings.
        settings: Its settings, plain values.

    Raises:
        DataError: The folder holds other files, or data of other settings. Nothing is written.
    """
    wanted = {"generator": generator, "version": version, "settings": dict(settings)}
    path = root / manifest
    remedy = "Name another folder, or remove this one to make it anew."
    # Before the manifest: whoever makes the same at the same time writes that first.
    foreign = sorted(p.name for p in root.iterdir() if p.name[0] != ".") if root.is_dir() else []
    if path.exists():
        found = _read_manifest(path, generator)
        if found != wanted:
            raise DataError(
                path,
                found=_differences(found, wanted),
                expected=_differences(wanted, found),
                remedy=remedy,
            )
        return
    if root.exists() and not root.is_dir():
        raise DataError(root, found="a file", expected="a folder", remedy=remedy)
    if foreign:
        raise DataError(
            root,
            found=f"files that are not {generator}' ({', '.join(foreign[:3])}, …)",
            expected="a new or empty folder",
            remedy="Name another folder.",
        )
    write_text(path, json.dumps(wanted, indent=1) + "\n")


def _read_manifest(manifest: Path, generator: str) -> dict[str, Any]:
    try:
        found = parse_json(manifest.read_text(encoding="utf-8"))
    except ValueError:
        found = None
    if not isinstance(found, dict):
        raise DataError(
            manifest,
            found="something else",
            expected=f"the settings of {generator} as JSON",
            remedy="Remove the folder to make it anew.",
        )
    return found


def _differences(one: dict[str, Any], other: dict[str, Any]) -> str:
    """What `one` says that `other` does not."""
    flat, others = _flatten(one), _flatten(other)
    return ", ".join(f"{k}={v}" for k, v in flat.items() if others.get(k) != v) or "nothing more"


def _flatten(manifest: dict[str, Any]) -> dict[str, Any]:
    settings = manifest.get("settings")
    return {**manifest, **(settings if isinstance(settings, dict) else {}), "settings": ""}
