"""Settings of a run for this machine, so that they are typed once: its data, loggers and callbacks.

Kept in the user's state folder by the place of the run's folder: nothing in a run folder, which may
be somebody else's, says what is read here.
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
    """Return the remembered settings of a run, such as ``data.root``; perhaps none.

    Args:
        folder: The run's folder.
        sections: Sections of the settings.
    """
    with suppress(OSError, ValueError):
        content = parse_json(_file(folder).read_bytes())
        if isinstance(content, dict) and all(isinstance(v, str) for v in content.values()):
            return {n: v for n, v in content.items() if n.partition(".")[0] in sections}
    return {}


def remember_settings(folder: Path, settings: Mapping[str, str]) -> None:
    """Keep settings of a run instead of earlier ones; not where nothing can be written.

    Args:
        folder: The run's folder.
        settings: Values as on a command line, by the name of the setting.
    """
    with suppress(OSError, NoRoomError):
        if settings:
            content = {"run": str(folder.resolve()), **settings}
            write_text(_file(folder), json.dumps(content) + "\n")
        else:
            _file(folder).unlink(missing_ok=True)


def _file(folder: Path) -> Path:
    state = os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state"
    place = hashlib.blake2b(os.fsencode(folder.resolve()), digest_size=16).hexdigest()
    return Path(state) / "tangent-train" / "runs" / f"{place}.json"
