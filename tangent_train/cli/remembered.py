"""Remember a run's settings for this machine (data, loggers, callbacks): they are typed only once.

They are stored in the user's state folder, under a hash of the run folder's path. Files in a run
folder, which may come from somebody else, have no influence on them.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Collection, Mapping
from contextlib import suppress
from pathlib import Path

from tangent_train.files import NoRoomError, parse_json, write_text


def remembered_settings(folder: Path, sections: Collection[str]) -> dict[str, str]:
    """Return the remembered settings of a run, such as ``data.root``; empty without any.

    Args:
        folder: Run folder.
        sections: Sections whose settings are returned.
    """
    with suppress(OSError, ValueError):
        content = parse_json(_file(folder).read_bytes())
        if isinstance(content, dict) and all(isinstance(v, str) for v in content.values()):
            return {n: v for n, v in content.items() if n.partition(".")[0] in sections}
    return {}


def remember_settings(folder: Path, settings: Mapping[str, str]) -> None:
    """Store settings of a run in place of earlier ones; do nothing if they cannot be written.

    Args:
        folder: Run folder.
        settings: Values as typed on a command line, by the name of the setting.
    """
    with suppress(OSError, NoRoomError):
        if settings:
            content = {"run": str(folder.resolve()), **settings}
            write_text(_file(folder), json.dumps(content) + "\n")
        else:
            _file(folder).unlink(missing_ok=True)


def _file(folder: Path) -> Path:
    state = os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state"
    digest = hashlib.blake2b(os.fsencode(folder.resolve()), digest_size=16).hexdigest()
    return Path(state) / "tangent-train" / "runs" / f"{digest}.json"
