"""``--help``: the settings with the comments of the config files they stand in."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from pathlib import Path

OWN = "== Its own settings =="
"""In a help template: the settings of the command's own file follow, without its groups."""

_COLUMN = 32


def annotate(text: str, folder: Path, command: str) -> str:
    """Add the comments of the config files to the settings in Hydra's help.

    Args:
        text: As Hydra prints it.
        folder: Folder of the configs.
        command: The command, ``<command>.yaml`` there.
    """
    own = folder / f"{command}.yaml"
    comments: dict[str, str] = {}
    # The options in use; of those that set the same object, the plainest last.
    files = [file for file in folder.glob("*/*.yaml") if _target(file) in text]
    for file in (*sorted(files, key=lambda file: (-len(file.name), file)), own):
        group = [] if file == own else [file.parent.name]
        for path, line in _settings(file.read_text("utf-8").splitlines(), group):
            comments[path] = line.partition(" # ")[2].strip()
    own_lines = (line.partition(" # ")[0].rstrip() for line in own.read_text("utf-8").splitlines())
    settings = [line for line in own_lines if re.match(r"(?!defaults|hydra)\w+:", line)]
    annotated = []
    for path, line in _settings(text.replace(OWN, "\n".join([OWN, *settings])).splitlines(), []):
        # photos.data.root is a data.root.
        comment = comments.get(path) or comments.get(path.partition(".")[2])
        annotated.append(f"{line:<{_COLUMN}}# {comment}\n" if comment else f"{line}\n")
    return "".join(annotated)


def _target(file: Path) -> str:
    found = re.search(r"^_target_: .*\n", file.read_text("utf-8"), re.MULTILINE)
    return found[0] if found else str(file)


def _settings(lines: Iterable[str], group: list[str]) -> Iterator[tuple[str, str]]:
    """Every line with the dotted name of its setting; "" where there is none."""
    parents: list[str] = []
    for line in lines:
        found = re.match(r"( *)(\w+):", line)
        if found:
            parents[len(found[1]) // 2 :] = [found[2]]
        yield ".".join([*group, *parents]) if found else "", line
