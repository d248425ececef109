"""``--help``: the settings of a command with the comments of the config files."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import yaml  # type: ignore[import-untyped]

_COLUMN = 32
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


def annotate(text: str, folder: Path, command: str) -> str:
    """Add the comments of the config files to the settings in Hydra's help.

    Args:
        text: Help text that Hydra has composed. If nothing follows its last heading, the settings
            of the command's own file are added, without its groups.
        folder: Folder of the configs.
        command: Name of the command, whose settings are in ``<command>.yaml``.
    """
    *head, printed = re.split(r"^(== Settings.*\n)", text, flags=re.MULTILINE)
    file = folder / f"{command}.yaml"
    values = yaml.safe_load(printed)
    if values is None:
        written = yaml.safe_load(file.read_text("utf-8"))
        values = {name: written[name] for name in written if name not in ("defaults", "hydra")}
    comments = _option_comments(folder)
    comments |= {("", name): setting.comment for name, setting in _with_bases(file).items()}
    return "".join([*head, *_explain(values, comments, (), ())])


def read_settings(file: Path) -> list[Setting]:
    """Return the settings of a config file, with the options that its defaults list chooses."""
    text = file.read_text("utf-8")
    return list(_settings(yaml.compose(text), text, ""))


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


def _option_comments(folder: Path) -> Comments:
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
        line = "  " * len(parents) + f"{key}:" + ("" if is_section else f" {_flow(value)}")
        yield f"{line:<{_COLUMN - 1}} # {comment}\n" if comment else f"{line}\n"
        if is_section:
            yield from _explain(value, comments, names, owners or [(key, 1)])


def _flow(value: Any) -> str:
    text = yaml.safe_dump(value, default_flow_style=True, width=10**6, allow_unicode=True)
    return text.removesuffix("...\n").strip()
