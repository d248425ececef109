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
        folder: Of the configs.
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
    lines = text.replace(OWN, "\n".join([OWN, *_own_lines(own)])).splitlines()
    return "\n".join(_annotated(lines, comments)) + "\n"


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


def _own_lines(file: Path) -> Iterator[str]:
    for line in file.read_text("utf-8").splitlines():
        if re.match(r"(?!defaults|hydra)\w+:", line):
            yield line.partition(" # ")[0].rstrip()


def _annotated(lines: Iterable[str], comments: dict[str, str]) -> Iterator[str]:
    for path, line in _settings(lines, []):
        # photos.data.root is that of data.root.
        comment = comments.get(path) or comments.get(path.partition(".")[2])
        yield f"{line:<{_COLUMN}}# {comment}" if comment else line
