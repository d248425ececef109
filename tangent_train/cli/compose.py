"""Finding configs, and taking paths literally, before anything heavy is imported."""

from __future__ import annotations

import re
from collections.abc import Sequence
from contextlib import suppress
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import get_type_hints

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Quote, QuotedString
from hydra.errors import HydraException

from tangent_train.cli.command_settings import SETTINGS
from tangent_train.registry import without_interpolation

_PLAIN = re.compile(r"(?!(null|true|false|inf|nan)$)[a-z_/][a-z0-9_/.-]*", re.IGNORECASE | re.ASCII)
"""Text that Hydra reads as this text, without quotes."""

_OF_A_SWEEP = re.compile(r"""('(?:[^'\\]|\\.)*'|"(?:[^"\\]|\\.)*"|[^,]*)(?:,|$)""", re.DOTALL)
"""One of several values, and the comma after it."""


def config_folder() -> Path:
    """Return the Hydra tree: the copy inside the wheel first, the checkout's second."""
    package = Path(__file__).resolve().parents[1]
    packaged = package / "configs"
    return packaged if packaged.is_dir() else package.parent / "configs"


def literal_paths(command: str, arguments: Sequence[str]) -> list[str]:
    """Quote the values of settings that are paths, so that Hydra takes them literally.

    A setting is a path if the class that takes it declares it as `Path`. Then everything after
    ``=`` is the path, except for ``~/``, which is the home folder; for ``null`` or nothing, which
    are no path; and for Hydra's quotes around the whole value. In a sweep, commas separate paths.
    The folders of Hydra (``hydra.run.dir``) keep their ``${…}``.

    Args:
        command: The command, such as predict.
        arguments: Its command line.

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
            is_quoted = _in_quotes(value) is not None
            text = value if is_quoted else QuotedString(value, Quote.single).with_quotes()
            literal.append(f"{name}={text}")
        elif _is_path(command, setting, value, arguments):
            paths = map(_quoted_path, values_of_sweep(value, arguments))
            literal.append(f"{name}={','.join(paths)}")
        else:
            literal.append(argument)
    return literal


def values_of_sweep(value: str, arguments: Sequence[str]) -> list[str]:
    """Return the values between commas in a sweep; without ``-m``, the whole value."""
    if {"-m", "--multirun", "hydra.mode=MULTIRUN"}.isdisjoint(arguments):
        return [value]
    return _OF_A_SWEEP.findall(f"{value},")[:-1]


def path_text(value: str) -> str:
    """Return the path that a value on a command line stands for, see `literal_paths`."""
    within = _in_quotes(value)
    if within is not None:
        return re.sub(r"(\\*)\1\\\$\{", r"\1${", within)
    return str(Path.home()) + value[1:] if re.match("~(/|$)", value) else value


def quoted(text: str) -> str:
    """Quote a string so that Hydra takes it literally, without interpolation."""
    if _PLAIN.fullmatch(text):
        return text
    return QuotedString(without_interpolation(text), Quote.single).with_quotes()


def _quoted_path(value: str) -> str:
    return "null" if value.lower() in ("", "null") else quoted(path_text(value))


def _in_quotes(value: str) -> str | None:
    """Text in Hydra's quotes; None if they are not around the whole value."""
    if len(value) > 1 and value[0] == value[-1] and value[0] in "'\"":
        with suppress(HydraException):
            found = OverridesParser.create().parse_override(f"x={value}").value()
            return found if isinstance(found, str) else None
    return None


def _is_path(command: str, setting: str, value: str, arguments: Sequence[str]) -> bool:
    """True for a setting that is declared as `Path`, unless it may be a number and is one."""
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
    """Annotations of a name in the source code of what may take it.

    These are the modules of the classes and functions that the options of a section's group name,
    in any folder of configs. Nothing is imported: torch takes seconds.
    """
    folders = config_folder(), *re.findall(r"(?:--config-dir|-cd)[=\0]([^\0]+)", arguments)
    files = [
        file for folder in folders for g in groups for file in Path(folder).glob(f"{g}/*.yaml")
    ]
    named = r"^ *_target_: *['\"]?([\w.]+)|\._target_=([\w.]+)"
    texts = (*(file.read_text("utf-8") for file in files), arguments)
    targets = {"".join(found) for text in texts for found in re.findall(named, text, re.MULTILINE)}
    modules = {target.rpartition(".")[0] for target in targets}
    sources = "\n".join(map(_source, modules))
    found = re.findall(rf"\b{name}: ([\w.|\[\] ]+)", sources)
    unions = [
        re.findall(rf"^{one.strip()} = (.*)", sources, re.MULTILINE)
        for one in found
        if one.strip().isidentifier()
    ]
    return f"{found} {unions}"


@cache
def _source(module: str) -> str:
    """Return the source code of a module, and of all modules below it in our packages."""
    top, *rest = module.split(".")
    # Of a whole package: finding a module in it would import the package.
    spec = find_spec(top) if top.isidentifier() else None
    if spec is None:
        return ""
    folders = [Path(folder, *rest) for folder in spec.submodule_search_locations or ()]
    pattern = "**/*.py" if top in ("datamodules", "models") else "__init__.py"
    files = [file for folder in folders for file in folder.glob(pattern)]
    files += [folder.with_suffix(".py") for folder in folders] or [Path(str(spec.origin))]
    found = (file for file in files if file.suffix == ".py" and file.is_file())
    return "\n".join(file.read_text("utf-8", errors="replace") for file in found)
