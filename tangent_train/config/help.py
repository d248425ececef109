"""Settings with their comments, for ``--help`` and the reference page."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from textwrap import wrap
from typing import Any, NamedTuple
from unittest.mock import patch

import yaml  # type: ignore[import-untyped]
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra.core.object_type import ObjectType

from tangent_train.config.settings import SETTINGS, Settings, comment_of, plain
from tangent_train.files import config_folder

_COLUMN, _WIDTH = 32, 100
_LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
"""The loader in C, which takes a tenth of the time, where PyYAML has it."""

_BASE = re.compile(r"^  - (?:/(\w+)@(\w+): )?(?!_self_)(\w+)$", re.MULTILINE)
_GENERAL = {
    "_target_": "Python class or function",
    "_partial_": "true: the run adds further arguments",
}

Comments = dict[tuple[str, str], str]
"""Comments by ``_target_`` (or group) and by the dotted name of the setting within it."""


class Setting(NamedTuple):
    """A setting in a config file.

    Attributes:
        name: Dotted name.
        value: Value as written in the file; empty for a section.
        comment: Comment on the same line.
    """

    name: str
    value: str
    comment: str


def listed_by_files() -> AbstractContextManager[Any]:
    """Let Hydra list the options of groups by their files: it composes the config for each group.

    Two thirds of the time of ``--help`` would be spent on it.
    """

    def options(
        loader: ConfigLoaderImpl, group_name: str, results_filter: Any = ObjectType.CONFIG
    ) -> list[str]:
        return loader.repository.get_group_options(group_name, results_filter)

    return patch.object(ConfigLoaderImpl, "get_group_options", options)


def annotate(text: str, command: str) -> str:
    """Add the comments of all settings to the help that Hydra has composed.

    Args:
        text: Help text, with the composed settings after the heading "Settings".
        command: Name of the command.
    """
    head, title, printed = re.split(r"^(== Settings.*\n)", text, flags=re.MULTILINE)
    values, comments = yaml.safe_load(printed), option_comments(config_folder())
    comments |= {("", s.name): s.comment for s in command_settings(command)}
    required = {name: "required" for name, value in values.items() if value == "???"}
    headings = _headings(SETTINGS[command]) | required
    lines = [line for text in head.splitlines() for line in _wrapped(text, "    ")] + [title[:-1]]
    for heading in dict.fromkeys(("required", *headings.values(), "other")):
        names = [name for name in values if headings.get(name, "other") == heading]
        # Sections last: they would separate the other settings.
        names.sort(key=lambda name: isinstance(values[name], dict))
        lines += [f"\n# --- {heading} ---"] * bool(names)
        lines += _explain({name: values[name] for name in names}, comments, (), ())
    return "\n".join([*lines, ""])


def _wrapped(text: str, indent: str, width: int = _WIDTH) -> list[str]:
    how: Any = {"break_long_words": False, "break_on_hyphens": False}
    return wrap(text, width, subsequent_indent=indent, **how) or [""]


def command_settings(command: str) -> list[Setting]:
    """Return the settings of a command; the values of groups are their default options."""
    file = config_folder() / f"{command}.yaml"
    files = [file, *(file.with_name(f"{name}.yaml") for _, _, name in bases(file))]
    settings = {one.name: one for one in _declared(SETTINGS[command], "")}
    for one in (one for file in files if file.exists() for one in read_settings(file)):
        if not one.name.startswith("hydra"):
            known = settings.get(one.name, one)
            settings[one.name] = known._replace(value=one.value or known.value)
    for name, value in re.findall(r"- override (\w+): (\w+)", file.read_text("utf-8")):
        settings[name] = settings[name]._replace(value=value)
    return list(settings.values())


def _declared(kind: type[Settings], prefix: str) -> Iterator[Setting]:
    for name, field in kind.model_fields.items():
        inner = field.annotation
        has_inner = isinstance(inner, type) and issubclass(inner, Settings)
        value = "" if has_inner or field.is_required() else _flow(plain(field.default))
        yield Setting(f"{prefix}{name}", value, comment_of(field))
        if has_inner:
            yield from _declared(inner, f"{prefix}{name}.")  # type: ignore[arg-type]


def _headings(kind: type[Settings]) -> dict[str, str]:
    """Return the headings above the settings of a class and its bases, from their source."""
    source, found = Path(inspect.getfile(kind)).read_text("utf-8"), dict[str, str]()
    for base in reversed(kind.__mro__):
        body = source.partition(f"class {base.__name__}(")[2].partition("\n\n\n")[0]
        for part in body.split("    # --- ")[1:]:
            heading, _, fields = part.partition(" ---\n")
            found |= dict.fromkeys(re.findall(r"^    (\w+): ", fields, re.MULTILINE), heading)
    return found


def read_settings(file: Path) -> list[Setting]:
    """Return the settings of a config file, with the options that its defaults list chooses."""
    text = file.read_text("utf-8")
    return list(_settings(yaml.compose(text, _LOADER), text, ""))


def description(file: Path) -> list[str]:
    """Return the lines of the comment at the top of a config file."""
    top = re.match(r"(?:#.*\n)*", file.read_text("utf-8"))
    return [line[2:] for line in top[0].splitlines() if "@package" not in line] if top else []


def bases(file: Path) -> list[tuple[str, str, str]]:
    """Return group, package and name of the options that a config file builds on.

    Group and package are empty for options of the file's own group.
    """
    defaults = file.read_text("utf-8").partition("defaults:\n")[2].partition("\n\n")[0]
    return _BASE.findall(defaults)


def _settings(section: Any, text: str, prefix: str) -> Iterator[Setting]:
    for key, value in section.value:
        comment = text.splitlines()[key.start_mark.line].partition(" # ")[2].strip()
        if key.value == "defaults":
            for choice in value.value:
                if isinstance(choice, yaml.MappingNode):
                    for name, option, meaning in _settings(choice, text, ""):
                        if not name.startswith(("/", "optional ", "override ")):
                            yield Setting(name.partition("@")[2] or name, option, meaning)
        elif isinstance(value, yaml.MappingNode) and not value.flow_style:
            yield Setting(prefix + key.value, "", comment)
            yield from _settings(value, text, f"{prefix}{key.value}.")
        else:
            written = text[value.start_mark.index : value.end_mark.index]
            yield Setting(prefix + key.value, written, comment)


def option_comments(folder: Path) -> Comments:
    """Return the comments of the options of all groups."""
    comments: Comments = {}
    files = sorted(folder.glob("*/*.yaml"))
    # The option without a base comes last: its comments replace those of others for its class.
    for file in sorted(files, key=lambda file: "\ndefaults:" not in file.read_text("utf-8")):
        settings = _with_bases(file)
        builds = [(s.value, s.name[:-8]) for s in settings.values() if s.name[-8:] == "_target_"]
        for owner, prefix in ((file.parent.name, ""), *builds):
            for setting in settings.values():
                if setting.comment and setting.name.startswith(prefix):
                    comments[owner, setting.name.removeprefix(prefix)] = setting.comment
            if not prefix:
                comments[owner, "_target_"] = " ".join(description(file)[:1])
    return comments


def _with_bases(file: Path) -> dict[str, Setting]:
    settings: dict[str, Setting] = {}
    for group, package, name in bases(file):
        base = _with_bases(file.parents[1] / (group or file.parent.name) / f"{name}.yaml")
        renamed = (s._replace(name=f"{package}.{s.name}".lstrip(".")) for s in base.values())
        settings |= {setting.name: setting for setting in renamed}
    return settings | {s.name: s for s in read_settings(file) if s.comment or s.value}


def _explain(
    values: Mapping[str, Any],
    comments: Comments,
    parents: tuple[str, ...],
    owners: Sequence[tuple[str, int]],
) -> Iterator[str]:
    if "_target_" in values:
        owners = [(values["_target_"], len(parents)), *owners]
    for key, value in values.items():
        names = (*parents, key)
        keys = [("", 0), *owners, ("debug", 0)]
        found = (comments.get((owner, ".".join(names[depth:]))) for owner, depth in keys)
        comment = next(filter(None, found), _GENERAL.get(key, ""))
        is_section = isinstance(value, Mapping) and value
        indent, left = "  " * len(parents), f"{key}:" + ("" if is_section else f" {_flow(value)}")
        *above, line = _wrapped(indent + left, indent + "    ")
        texts = [" " * _COLUMN + f"# {one}" for one in _wrapped(comment, "", _WIDTH - _COLUMN - 2)]
        if len(line) < _COLUMN and comment:  # beside it, else below
            line = f"{line:<{_COLUMN}}" + texts.pop(0)[_COLUMN:]
        yield from (*above, line, *(texts if comment else ()))
        if is_section:
            yield from _explain(value, comments, names, owners or [(key, 1)])


def _flow(value: Any) -> str:
    text = yaml.safe_dump(value, default_flow_style=True, width=10**6, allow_unicode=True)
    return text.removesuffix("...\n").strip()
