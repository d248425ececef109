"""Folders of generated data: marked with their settings; other folders are left alone."""

from __future__ import annotations

import json
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from tangent_train.errors import DataError
from tangent_train.files import write_text


def claim_folder(
    root: Path, manifest: str, generator: str, version: int, settings: Mapping[str, Any]
) -> None:
    """Check that a folder may be written to, and mark it as generated.

    Args:
        root: Folder of the data set: new, empty, or generated with the same settings.
        manifest: Name of the file that marks the folder and holds the settings.
        generator: Name of the generator.
        version: Version of the generator; other versions generate other files.
        settings: Settings of the generator, plain values.

    Raises:
        DataError: The folder holds other files, or data of other settings; nothing is written.
    """
    about = {"generator": generator, "version": version}
    wanted, found = {**about, **settings}, dict[str, Any]()
    path = root / manifest
    # Before reading the manifest: a concurrent process writes it first.
    foreign = sorted(p.name for p in root.iterdir() if p.name[0] != ".") if root.is_dir() else []
    if path.exists():
        with suppress(ValueError, TypeError, KeyError):  # not a manifest
            content = json.loads(path.read_bytes())
            found = {key: content[key] for key in about} | content["settings"]
        if found != wanted:
            other = [key for key in wanted if found.get(key) != wanted[key]]
            raise DataError(
                path,
                found=", ".join(f"{key}={found.get(key)}" for key in other),
                expected=", ".join(f"{key}={wanted[key]}" for key in other),
                remedy="Name another folder, or delete this one to generate it again.",
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
