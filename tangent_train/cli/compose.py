"""Finding configs, before anything heavy is imported."""

from __future__ import annotations

import re
from pathlib import Path

from hydra.core.override_parser.types import Quote, QuotedString

_PATHS = (
    *("back", "cameras", "checkpoint", "class_map", "classes", "depth", "figure", "file"),
    *("init_from", "input", "left", "mask", "model", "output", "resume", "right", "weights"),
)
"""Settings that name files or folders."""


def config_folder() -> Path:
    """The Hydra tree: the copy inside the wheel first, the checkout's second."""
    package = Path(__file__).resolve().parents[1]
    packaged = package / "configs"
    return packaged if packaged.is_dir() else package.parent / "configs"


def named(argument: str, setting: str) -> str:
    """Keep a setting with the name of a config group a setting.

    Hydra never takes a mapping for the choice of an option.

    >>> named("network=unet", "network"), named("level=7", "network")
    ('network={name:unet}', 'level=7')
    """
    name, _, value = argument.partition("=")
    return f"{name}={{name:{value}}}" if name == setting and value else argument


def quote_path(argument: str) -> str:
    """Quote an override of a file or folder, so that Hydra takes its value literally.

    >>> quote_path("input=holiday (1)/a=b,c.jpg"), quote_path("level=7"), quote_path("depth=null")
    ("input='holiday (1)/a=b,c.jpg'", 'level=7', 'depth=null')
    """
    name, _, value = argument.partition("=")
    if name not in _PATHS or value in ("", "null") or value[0] in "'\"":
        return argument
    return f"{name}={quoted(value)}"


def quoted(text: str) -> str:
    """Quote a string so that Hydra takes it literally, without interpolation."""
    if re.fullmatch(r"[\w/.+-]+", text):
        return text
    return QuotedString(text.replace("${", r"\${"), Quote.single).with_quotes()
