"""Folders of generated data: marked with their settings; other folders are left alone."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from tangent_train.errors import DataError
from tangent_train.files import parse_json, write_text

__all__ = ["claim_folder"]


def claim_folder(
    root: Path, manifest: str, generator: str, version: int, settings: Mapping[str, Any]
) -> None:
    """Make sure that a folder is ours to write to, and mark it.

    Args:
        root: Folder of the data set: new, empty, or of the same settings.
        manifest: Name of the file in it that marks it and holds the settings.
        generator: Name of the generator.
        version: Its version; another version generates other files from the same settings.
        settings: Its settings, plain values.

    Raises:
        DataError: The folder holds other files, or data of other settings. Nothing is written.
    """
    wanted = {"generator": generator, "version": version, "settings": dict(settings)}
    path = root / manifest
    # Before the manifest: whoever makes the same at the same time writes that first.
    foreign = sorted(p.name for p in root.iterdir() if p.name[0] != ".") if root.is_dir() else []
    if path.exists():
        found = _read(path)
        if found != wanted:
            one, other = _flat(found), _flat(wanted)
            raise DataError(
                path,
                found=", ".join(f"{k}={one.get(k)}" for k in other if one.get(k) != other[k]),
                expected=", ".join(f"{k}={v}" for k, v in other.items() if one.get(k) != v),
                remedy="Name another folder, or remove this one to make it anew.",
            )
        return
    if foreign or (root.exists() and not root.is_dir()):
        raise DataError(
            root,
            found=f"files that are not {generator}' ({', '.join(foreign[:3])}, …)",
            expected="a new or empty folder",
            remedy="Name another folder.",
        )
    write_text(path, json.dumps(wanted, indent=1) + "\n")


def _read(manifest: Path) -> Any:
    try:
        return parse_json(manifest.read_bytes())
    except ValueError:
        return None


def _flat(manifest: Any) -> dict[str, Any]:
    """Generator, version and settings; nothing of what is no manifest."""
    if not isinstance(manifest, dict) or not isinstance(manifest.get("settings"), dict):
        return {}
    return {"generator": manifest.get("generator"), "version": manifest.get("version"),
            **manifest["settings"]}  # fmt: skip
