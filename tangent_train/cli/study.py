"""``tangent-study``: what the command line says, and the files it leaves."""

from __future__ import annotations

import difflib
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from tangent_train.cli.studies.catalogue import STUDIES
from tangent_train.errors import SettingError
from tangent_train.json_text import parse_json

__all__ = ["study"]

_ALL = "all"
_PATHS = ("mnist", "output")
"""Settings whose values are taken as they are."""


def study(arguments: Sequence[str]) -> None:
    """Make studies: print their tables, write ``<name>.png`` and ``<name>.csv``.

    Args:
        arguments: The command line after the program's name: names, and settings as ``name=value``.

    Raises:
        DataError: MNIST's files cannot be read.
        SettingError: A study or setting is unknown or cannot work, or the output folder holds
            files of these names that no study left there.
    """
    if not arguments or {"--help", "-h"} & set(arguments):
        _print(_help())
        return
    names, settings = _parse(arguments)
    folder = Path(str(settings["output"])).expanduser()
    checked = {name: STUDIES[name].check(settings) for name in names}
    _check_output(folder, names)
    # Heavy, and not needed to say what is wrong with the command line.
    from rich.console import Console
    from rich.status import Status

    from tangent_train.files import write_bytes, write_text

    console = Console(highlight=False)
    for name in names:
        with console.status(f"{name} …") as status:

            def say(text: str, name: str = name, status: Status = status) -> None:
                status.update(f"{name}: {text}")

            found = STUDIES[name].run(checked[name], say)
        # The picture first: it bears the mark by which both may be written again.
        write_bytes(folder / f"{name}.png", found.png)
        write_text(folder / f"{name}.csv", found.csv())
        console.print(found.table())
        for note in found.notes:
            console.print(f"- {note}", soft_wrap=True, markup=False)
        console.print(f"{folder / name}.png, .csv\n", soft_wrap=True, markup=False)


_OUTPUT = {"output": ("study", "folder for <name>.png and <name>.csv")}


def _help() -> str:
    lines = [
        "usage: tangent-study <name> … [setting=value …]",
        "",
        "The paper's figures about distortion, each as a table, a PNG and a CSV file.",
        "",
        "studies:",
        *(f"  {name:27}{one.about}" for name, one in STUDIES.items()),
        f"  {_ALL:27}all of them",
        "",
        "settings:",
    ]
    of_all = {"all studies": _OUTPUT} | {name: one.settings for name, one in STUDIES.items()}
    for name, settings in of_all.items():
        lines += [f"  {name}"]
        for setting, (default, about) in settings.items():
            shown = "null" if default is None else str(default).replace(" ", "")
            lines += [f"    {f'{setting}={shown}':25}{about}"]
    return "\n".join([*lines, "", "Example: tangent-study surface_area fov output=figures"])


def _print(text: str) -> None:
    from rich.console import Console

    Console(highlight=False).print(text, markup=False, soft_wrap=True)


def _parse(arguments: Sequence[str]) -> tuple[list[str], dict[str, Any]]:
    """Names of studies, and all their settings."""
    typed = [argument for argument in arguments if "=" not in argument]
    for name in typed:
        if name not in (*STUDIES, _ALL):
            remedy = "Settings are written as output=figures." if name.startswith("-") else ""
            _refuse("study", name, [*STUDIES, _ALL], remedy)
    names = list(STUDIES) if _ALL in typed else list(dict.fromkeys(typed))
    if not names:
        expected = f"one of {', '.join([*STUDIES, _ALL])}"
        raise SettingError("study", found="none", expected=expected)
    known = dict(_OUTPUT)
    for name in names:
        known |= STUDIES[name].settings
    settings = {name: default for name, (default, _) in known.items()}
    for argument in arguments:
        if "=" in argument:
            name, _, value = argument.partition("=")
            if name not in known:
                _refuse("setting", name, list(known), _whose(name))
            settings[name] = _value(name, value)
    return names, settings


def _value(name: str, text: str) -> Any:
    """What is typed, typed: numbers, lists, null; see `_PATHS`."""
    if not text:
        raise SettingError(name, found="nothing", expected="a value behind the =")
    if name in _PATHS:
        return None if text == "null" and name != "output" else text
    try:
        return parse_json(text)
    except ValueError:
        return text


def _whose(setting: str) -> str:
    """Of which other studies it is a setting."""
    owners = [name for name, one in STUDIES.items() if setting in one.settings]
    return f"It is a setting of {' and '.join(owners)}." if owners else ""


def _refuse(kind: str, found: str, known: list[str], remedy: str = "") -> None:
    near = difflib.get_close_matches(found, known, n=3, cutoff=0.6)
    if near:
        remedy = f"Did you mean {' or '.join(near)}? {remedy}".rstrip()
    raise SettingError(
        f"unknown {kind}", found=f"'{found}'", expected=", ".join(known), remedy=remedy
    )


def _check_output(folder: Path, names: Sequence[str]) -> None:
    """Refuse to write where no folder can be, and over files that no study left there."""
    parent = next((path for path in folder.absolute().parents if path.exists()), folder)
    place = folder if folder.exists() else parent
    if not place.is_dir() or not os.access(place, os.W_OK):
        raise SettingError("output", found=str(folder), expected="a folder that can be written")
    for name in names:
        pair = [folder / f"{name}.png", folder / f"{name}.csv"]
        there = [path for path in pair if path.exists()]
        if there and not _is_study(pair[0]):
            raise SettingError(
                "output",
                found=f"{there[0]}, which tangent-study did not write",
                expected="a new folder, or one with earlier studies",
                remedy="Give another folder.",
            )


def _is_study(picture: Path) -> bool:
    """Whether a picture bears the mark."""
    from PIL import Image

    from studies.outcome import MADE_BY

    try:
        with Image.open(picture) as image:
            return bool(image.info.get("Software") == MADE_BY)
    except OSError:
        return False
