"""What happens in the world before a command: what it makes is not there, what it reads is."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path

from tests.slow.documentation.world import RGB_CHECKPOINT

MADE_FIRST = {
    name: ("tangent-export", f"checkpoint={RGB_CHECKPOINT}", f"output={name}")
    for name in ("model.onnx", "model.safetensors")
}
"""Files that take a while to make, and how: only for commands that read them."""

_WRITTEN = ("figure", "output")
"""Settings that name what a command makes."""

_READ = ("back", "cameras", "checkpoint", "depth", "input")
"""Settings that name what has to be there."""


def make_way(words: Sequence[str], folder: Path) -> None:
    """Take away what a command is to make.

    Args:
        words: From `stand_in`.
        folder: That it runs in.
    """
    for word in words[1:]:
        name, _, value = word.partition("=")
        place = folder / value
        if name in _WRITTEN and place != folder:
            shutil.rmtree(place) if place.is_dir() else place.unlink(missing_ok=True)


def made_first(words: Sequence[str], folder: Path) -> list[tuple[str, ...]]:
    """What has to be run before a command for files that the world does not have.

    Args:
        words: From `stand_in`.
        folder: That it runs in.
    """
    read = [word.partition("=")[2] for word in words if not word.startswith("output=")]
    script = folder / words[1] if words[0].startswith("python") and len(words) > 1 else folder
    text = script.read_text() if script.is_file() else ""
    wanted = [name for name in MADE_FIRST if name in read or f'"{name}"' in text]
    return [MADE_FIRST[name] for name in wanted if not (folder / name).exists()]


def needs_its_block(words: Sequence[str], folder: Path) -> bool:
    """Whether a command goes on from what the commands above it in its block have made."""
    named = dict(word.partition("=")[::2] for word in words[1:])
    missing = any(
        name in _READ and value and not (folder / value).exists() and value not in MADE_FIRST
        for name, value in named.items()
        if "*" not in value
    )
    return missing or (words[0].startswith("python") and words[1] != "-m")
