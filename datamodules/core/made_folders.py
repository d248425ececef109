"""Folders of generated data: marked with their settings; other folders are left alone."""

from __future__ import annotations

import json
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from tangent_train.errors import DataError
from tangent_train.files import parse_json, write_text


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
    about = {"generator": generator, "version": version}
    wanted, found = {**about, **settings}, dict[str, Any]()
    path = root / manifest
    # Before the manifest: whoever makes the same at the same time writes that first.
    foreign = sorted(p.name for p in root.iterdir() if p.name[0] != ".") if root.is_dir() else []
    if path.exists():
        with suppress(ValueError, TypeError, KeyError):  # it is no manifest then
            content = parse_json(path.read_bytes())
            found = {key: content[key] for key in about} | content["settings"]
        if found != wanted:
            other = [key for key in wanted if found.get(key) != wanted[key]]
            raise DataError(
                path,
                found=", ".join(f"{key}={found.get(key)}" for key in other),
                expected=", ".join(f"{key}={wanted[key]}" for key in other),
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
    write_text(path, json.dumps({**about, "settings": dict(settings)}, indent=1) + "\n")


def require_generated(root: Path) -> None:
    """Refuse a generated data set whose folder is missing.

    Raises:
        DataError: There is no such folder.
    """
    if not root.is_dir():
        remedy = "Run tangent-prepare with the same settings."
        raise DataError(root, found="no such folder", expected="the data set", remedy=remedy)
