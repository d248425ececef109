"""Where the data of a run are on this machine, so that they are typed once.

Kept in the user's state folder by the place of the run's folder: nothing in a run folder, which may
be somebody else's, says what is read here.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

from tangent_train.files import NoRoomError, parse_json, write_text


def remembered_paths(folder: Path) -> dict[str, str]:
    """Settings of a run that are paths of this machine, such as ``data.root``; perhaps none.

    Args:
        folder: The run's folder.
    """
    with suppress(OSError, ValueError):
        content = parse_json(_file(folder).read_bytes())
        if isinstance(content, dict) and all(isinstance(v, str) for v in content.values()):
            return {name: path for name, path in content.items() if name.startswith("data.")}
    return {}


def remember_paths(folder: Path, paths: Mapping[str, str]) -> None:
    """Keep the paths of a run instead of earlier ones; not where nothing can be written.

    Args:
        folder: The run's folder.
        paths: Paths by the name of the setting.
    """
    with suppress(OSError, NoRoomError):
        if paths:
            write_text(_file(folder), json.dumps({"run": str(folder.resolve()), **paths}) + "\n")
        else:
            _file(folder).unlink(missing_ok=True)


def _file(folder: Path) -> Path:
    state = os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state"
    place = hashlib.blake2b(os.fsencode(folder.resolve()), digest_size=16).hexdigest()
    return Path(state) / "tangent-train" / "runs" / f"{place}.json"
