"""Find configs and quote paths on the command line, before anything heavy is imported."""

from __future__ import annotations

import re
from collections.abc import Sequence
from contextlib import suppress
from functools import cache
from importlib.util import find_spec
from itertools import pairwise
from pathlib import Path
from typing import get_type_hints

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Quote, QuotedString
from hydra.errors import HydraException

from tangent_train.cli.command_settings import SETTINGS
from tangent_train.config.build import without_interpolation
from tangent_train.files import config_folder

_PLAIN = re.compile(r"(?!(null|true|false|inf|nan)$)[a-z_/][a-z0-9_/.-]*", re.IGNORECASE | re.ASCII)
"""Text that Hydra reads literally without quotes."""

_OPTION_WITH_VALUE = re.compile(
    "--(cfg|config-(dir|name|path)|experimental-rerun|info|package)|-(c|cd|cn|cp|i|p)"
)
"""Options of Hydra whose value is the next argument."""

_SWEEP_VALUE = re.compile(r"""('(?:[^'\\]|\\.)*'|"(?:[^"\\]|\\.)*"|[^,]*)(?:,|$)""", re.DOTALL)
"""One value of a sweep, and the comma after it."""


def overrides_first(arguments: Sequence[str]) -> list[str]:
    """Move options behind the overrides: Hydra refuses overrides on both sides of an option.

    Args:
        arguments: Command line after the program's name.

    >>> overrides_first(["level=7", "--config-dir", "own", "level=8", "-m", "--cfg", "job"])
    ['level=7', 'level=8', '--config-dir', 'own', '-m', '--cfg', 'job']
    """
    ordered = sorted(  # which keeps the order of the overrides: the last one of a setting wins
        pairwise(["", *arguments]),
        key=lambda pair: pair[1].startswith("-") or bool(_OPTION_WITH_VALUE.fullmatch(pair[0])),
    )
    return [argument for _, argument in ordered]


def literal_paths(command: str, arguments: Sequence[str]) -> list[str]:
    """Quote the values of settings that are paths, so that Hydra takes them literally.

    A setting is a path if the class that takes it declares it as `Path`. Then everything after
    ``=`` is the path, with three exceptions: ``~/`` is the home folder, ``null`` or nothing is
    null, and Hydra's quotes around the whole value are removed. In a sweep, commas separate paths.
    In the folders of Hydra (``hydra.run.dir``), ``${…}`` is still replaced.

    Args:
        command: Name of the command, e.g. predict.
        arguments: Command line after the program's name.

    >>> literal_paths("predict", ["input=holiday (1)/a=b,c.jpg", "level=7", "depth=null"])
    ["input='holiday (1)/a=b,c.jpg'", 'level=7', 'depth=null']
    """
    literal = []
    for argument in arguments:
        name, _, value = argument.partition("=")
        setting = name.lstrip("+")
        if _PLAIN.fullmatch(value) or not re.fullmatch(r"\w[\w.]*", setting):
            literal.append(argument)
        elif re.fullmatch(r"hydra\..*\bdir", setting):
            is_quoted = _unquoted(value) is not None
            text = value if is_quoted else QuotedString(value, Quote.single).with_quotes()
            literal.append(f"{name}={text}")
        elif _is_path(command, setting, value, arguments):
            paths = map(_quoted_path, values_of_sweep(value, arguments))
            literal.append(f"{name}={','.join(paths)}")
        else:
            literal.append(argument)
    return literal


def values_of_sweep(value: str, arguments: Sequence[str]) -> list[str]:
    """Split a value at its commas in a sweep (``-m``); else return the whole value."""
    if {"-m", "--multirun", "hydra.mode=MULTIRUN"}.isdisjoint(arguments):
        return [value]
    return _SWEEP_VALUE.findall(f"{value},")[:-1]


def path_text(value: str) -> str:
    """Return the path that a value on a command line means, see `literal_paths`."""
    unquoted = _unquoted(value)
    if unquoted is not None:
        return re.sub(r"(\\*)\1\\\$\{", r"\1${", unquoted)
    return str(Path.home()) + value[1:] if re.match("~(/|$)", value) else value


def quoted(text: str) -> str:
    """Quote a string so that Hydra takes it literally, without interpolation."""
    if _PLAIN.fullmatch(text):
        return text
    return QuotedString(without_interpolation(text), Quote.single).with_quotes()


def _quoted_path(value: str) -> str:
    return "null" if value.lower() in ("", "null") else quoted(path_text(value))


def _unquoted(value: str) -> str | None:
    """Return the text inside Hydra's quotes; None if they are not around the whole value."""
    if len(value) > 1 and value[0] == value[-1] and value[0] in "'\"":
        with suppress(HydraException):
            text = OverridesParser.create().parse_override(f"x={value}").value()
            return text if isinstance(text, str) else None
    return None


def _is_path(command: str, setting: str, value: str, arguments: Sequence[str]) -> bool:
    """Return True for a setting declared as `Path`, unless it may be a number and is one."""
    *groups, name = setting.split(".")
    if groups:
        declared = _annotations(groups, name, "\0".join(arguments))
    else:
        declared = str(get_type_hints(SETTINGS[command]).get(name))
    types = set(re.findall(r"\w+", declared))
    if types & {"float", "int"}:
        with suppress(ValueError):
            float(value)
            return False
    return "Path" in types


def _annotations(groups: Sequence[str], name: str, arguments: str) -> str:
    """Find the annotations of an argument in the source code of the classes that may take it.

    The options of a section's group, in every folder of configs, name these classes and functions.
    Nothing is imported: torch takes seconds.
    """
    folders = config_folder(), *re.findall(r"(?:--config-dir|-cd)[=\0]([^\0]+)", arguments)
    files = [
        file for folder in folders for g in groups for file in Path(folder).glob(f"{g}/*.yaml")
    ]
    named = r"^ *_target_: *['\"]?([\w.]+)|\._target_=([\w.]+)"
    texts = (*(file.read_text("utf-8") for file in files), arguments)
    targets = {"".join(both) for text in texts for both in re.findall(named, text, re.MULTILINE)}
    modules = {target.rpartition(".")[0] for target in targets}
    sources = "\n".join(map(_source, modules))
    hints = re.findall(rf"\b{name}: ([\w.|\[\] ]+)", sources)
    unions = [
        re.findall(rf"^{hint.strip()} = (.*)", sources, re.MULTILINE)
        for hint in hints
        if hint.strip().isidentifier()
    ]
    return f"{hints} {unions}"


@cache
def _source(module: str) -> str:
    """Return the source code of a module; in our packages also of the modules below it."""
    top, *rest = module.split(".")
    # The top package only: finding a module inside it would import the package.
    spec = find_spec(top) if top.isidentifier() else None
    if spec is None:
        return ""
    folders = [Path(folder, *rest) for folder in spec.submodule_search_locations or ()]
    pattern = "**/*.py" if top in ("datamodules", "models") else "__init__.py"
    files = [file for folder in folders for file in folder.glob(pattern)]
    files += [folder.with_suffix(".py") for folder in folders] or [Path(str(spec.origin))]
    existing = (file for file in files if file.suffix == ".py" and file.is_file())
    return "\n".join(file.read_text("utf-8", errors="replace") for file in existing)
