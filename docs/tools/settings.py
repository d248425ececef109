"""Write the reference pages of settings, experiments and protocols from their files.

``python -m docs.tools.settings`` writes them; a test fails if they are out of date.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Collection, Iterable, Mapping
from pathlib import Path

from tangent_train.config.help import (
    Setting,
    bases,
    command_settings,
    description,
    read_settings,
)
from tangent_train.config.settings import SETTINGS, RunSettings
from tangent_train.files import config_folder
from tangent_train.results.published import facts, protocols

CONFIGS = config_folder()
REFERENCE = Path(__file__).parents[1] / "reference"
COMMANDS = ("train", "evaluate", "transfer", "prepare", "check",
            "predict", "import", "export", "render", "keypoints")  # fmt: skip
GROUPS = {
    "data": ("data",),
    "networks": ("representation", "network"),
    "runs": ("task", "optimizer", "scheduler", "trainer", "logger", "callbacks", "recipe",
             "debug", "sweep", "launcher"),
}  # fmt: skip
"""Groups by the page of their settings."""

_PAGE_OF = {group: page for page, groups in GROUPS.items() for group in groups}
_HEADS = {
    "data": "# Settings of data sets\n\n[Data sets](../data_sets.md) lists content and files.\n",
    "networks": "# Settings of views and networks\n\n`network.in_channels` and "
    "`network.num_classes` follow from the data and are not listed.\n",
    "runs": "# Settings of runs\n",
}
_COMMON = 0.4
"""Share of the options from which a setting is described once for the group."""
_USUAL_FACTS = {"area": "none", "mask": "none", "test_rotation": "none", "weighting": "pixels"}
"""Facts of most protocols, which the page states once."""

_MARK = "<!-- generated -->\n"


def pages() -> dict[Path, str]:
    """Return the generated pages by their paths."""
    generated: dict[str, Iterable[str]] = {
        "settings/commands.md": (_below_head("settings/commands.md"), *_commands())
    }
    for page, groups in GROUPS.items():
        generated[f"settings/{page}.md"] = (_HEADS[page], *map(_group, groups))
    experiments = map(_experiment, sorted((CONFIGS / "experiment").rglob("*.yaml")))
    generated["experiments.md"] = (_below_head("experiments.md"), *experiments, "")
    data_sets = dict.fromkeys(facts(name)["data"] for name in protocols())
    generated["protocols.md"] = (_below_head("protocols.md"), *map(_data_set, data_sets))
    return {REFERENCE / name: "\n".join(parts) for name, parts in generated.items()}


def _below_head(name: str) -> str:
    """Return the text of a page above its mark, which is written by hand, and the mark."""
    return (REFERENCE / name).read_text("utf-8").partition(_MARK)[0] + _MARK


def _data_set(data: str) -> str:
    """Return the section of a data set: the source and the facts of its protocols."""
    found = {name: facts(name) for name in protocols() if facts(name)["data"] == data}
    counts = Counter(fact for of in found.values() for fact in of.items())
    usual = dict(fact for fact, count in counts.items() if count > max(1, len(found) / 2))
    items = []
    for name, of in found.items():
        entry = protocols()[name]
        every = dict.fromkeys(usual, "") | of  # depth has no classes
        own = _facts({fact: value for fact, value in every.items() if usual.get(fact) != value})
        run = f"Experiment: `{entry['experiment']}`" if "experiment" in entry else ""
        parts = [
            f"{part.removesuffix('.')}." for part in (entry.get("about", ""), own, run) if part
        ]
        items.append(f"* `{name}`: {' '.join(parts)}" if parts else f"* `{name}`")
    start = f"Unless stated otherwise: {_facts(usual)}.\n\n" if _facts(usual) else ""
    return f"## {data}\n\n{start}" + "\n".join([*items, ""])


def _facts(values: Mapping[str, str]) -> str:
    shown = {k: v for k, v in values.items() if k != "data" and _USUAL_FACTS.get(k) != v}
    return "; ".join(f"`{k}` {v}" if v else f"no `{k}`" for k, v in shown.items())


def _commands() -> Iterable[str]:
    """Yield the sections of the commands; a setting of several commands is described once."""
    described: dict[Setting, str] = {}
    for name in COMMANDS:
        settings = [one for one in command_settings(name) if one.value or one.comment]
        notes = []
        if name != "train" and issubclass(SETTINGS[name], RunSettings):
            notes = ["It has the settings of `tangent-train` except for `init_from` and `resume`."]
            settings = [one for one in settings if described.get(one) != "train"]
        seen = {one.name: described[one] for one in settings if one in described}
        notes += _as_in(seen, "tangent-")
        own = [one for one in settings if one not in described]
        described |= dict.fromkeys(own, name)
        about = _text(description(CONFIGS / f"{name}.yaml")[0])
        parts = [f"## tangent-{name}", about, " ".join(notes), _list(own)]
        yield "\n\n".join(part.rstrip() for part in parts if part) + "\n"


def _as_in(owners: Mapping[str, str], prefix: str) -> list[str]:
    return [
        f"As in `{prefix}{owner}`: {_listed(one for one in owners if owners[one] == owner)}."
        for owner in dict.fromkeys(owners.values())
    ]


def _listed(codes: Iterable[str]) -> str:
    return ", ".join(f"`{code}`" for code in codes)


def _group(name: str) -> str:
    """Return the options of a group; settings of most options are described once, first."""
    files = sorted((CONFIGS / name).glob("*.yaml"))
    listed = {file: [s for s in read_settings(file) if _is_shown(s)] for file in files}
    complete = [listed[file] for file in files if not _own_bases(file)]
    values: dict[tuple[str, str], Counter[str]] = {}
    for setting in (one for settings in complete for one in settings):
        values.setdefault((setting.name, setting.comment), Counter())[setting.value] += 1
    common = [
        Setting(key[0], counts.most_common(1)[0][0], key[1])
        for key, counts in values.items()
        if counts.total() >= max(2, _COMMON * len(complete))
    ]
    described: dict[tuple[str, str], tuple[str, str]] = {}
    parts = [f"## {name}\n"]
    parts += [f"Common settings:\n\n{_list(common, _prefix(files[0]))}"] if common else []
    return "\n".join([*parts, *(_option(file, listed, common, described) for file in files)])


def _option(
    file: Path,
    listed: Mapping[Path, list[Setting]],
    common: Collection[Setting],
    described: dict[tuple[str, str], tuple[str, str]],
) -> str:
    group, bases_ = file.parent.name, _own_bases(file)
    usual = {(one.name, one.comment): one.value for one in common}
    inherited = {(one.name, one.comment) for base in bases_ for one in _with_bases(base, listed)}
    changes, seen, own = [], {}, []
    for one in listed[file]:
        key = (one.name, one.comment)
        typed = f"{one.name}={_written(one)}"
        if key in inherited or key in usual:
            changes += [typed] if key in inherited or one.value != usual[key] else []
        elif key in described:
            owner, value = described[key]
            seen[one.name if one.value == value else typed] = owner
        else:
            own.append(one)
            described[key] = file.stem, one.value
    with_changes = f", with {_listed(changes)}" if changes else ""
    based = f"Based on {_listed(f'{group}={base.stem}' for base in bases_)}{with_changes}."
    names = {one.name for one in listed[file]}
    other = [one for one in common if one.name not in {setting.name for setting in own}]
    notes = [based] if bases_ else _of_common(names, other, changes)
    notes += _as_in(seen, f"{group}=")
    rows = _list(own, _prefix(file)).rstrip()
    parts = [f"### {group}={file.stem}", _prose(file), " ".join(notes), rows]
    return "\n\n".join(filter(None, parts)) + "\n"


def _of_common(
    names: Collection[str], common: Collection[Setting], changes: Iterable[str]
) -> list[str]:
    """Return notes on other defaults of the common settings, and on those that an option lacks."""
    changed = {text.partition("=")[0]: text for text in changes}
    has = [changed.get(one.name, one.name) for one in common if one.name in names]
    lacks = [one.name for one in common if one.name not in names]
    if len(lacks) > len(has):
        return [f"Of the common settings only {_listed(has)}." if has else "No common settings."]
    notes = [f"Other defaults: {_listed(changed.values())}."] if changed else []
    return [*notes, f"Common settings except {_listed(lacks)}."] if lacks else notes


def _own_bases(file: Path) -> list[Path]:
    return [file.with_name(f"{name}.yaml") for group, _, name in bases(file) if not group]


def _with_bases(file: Path, listed: Mapping[Path, list[Setting]]) -> list[Setting]:
    inner = [one for base in _own_bases(file) for one in _with_bases(base, listed)]
    return [*listed[file], *inner]


def _prefix(file: Path) -> str:
    is_global = "@package" in file.read_text("utf-8").partition("\n")[0]
    return "" if is_global else f"{file.parent.name}."


def _experiment(file: Path) -> str:
    name = file.relative_to(CONFIGS / "experiment").with_suffix("").as_posix()
    about = re.split(r"(?<! al)\.(?: |$)", " ".join(description(file)))[0]
    return f"* `{name}`: {_text(about, '../')}"


def _is_shown(setting: Setting) -> bool:
    is_plumbing = setting.name.endswith(("_target_", "_partial_"))
    return bool(setting.value) and not is_plumbing and "null = from the data" not in setting.comment


def _list(settings: Iterable[Setting], prefix: str = "") -> str:
    listed = list(settings)
    sections = {one.name.rpartition(".")[0] for one in listed}
    items = [
        ": ".join(filter(None, (_name(one, prefix, sections), _text(one.comment))))
        for one in listed
    ]
    return "".join(f"* {item}\n" for item in items)


def _name(setting: Setting, prefix: str, sections: Collection[str]) -> str:
    group = setting.name.rpartition(".")[2]
    value = "" if setting.name in sections else f"={_written(setting)}"
    code = f"`{prefix}{setting.name}{value}`"
    return f"[{code}]({_PAGE_OF[group]}.md#{group})" if group in _PAGE_OF else code


def _written(setting: Setting) -> str:
    """Return the value of a setting as it is typed; … stands for a required one."""
    if "required, unless" in setting.comment:
        return "…"
    if setting.value.startswith("- "):
        return f"[{', '.join(re.findall(r'- (.+)', setting.value))}]"
    return " ".join(setting.value.split()) or "…"


def _prose(file: Path) -> str:
    return "\n".join(
        f"`{line.strip()}`" if line.startswith("  ") else _text(line) for line in description(file)
    )


def _text(comment: str, up: str = "../../") -> str:
    escaped = re.sub(r"([|<*\[\]])", r"\\\1", comment)
    return re.sub(r"docs/([\w/-]+\.md)", rf"[\1]({up}\1)", escaped)


if __name__ == "__main__":
    for path, text in pages().items():
        path.parent.mkdir(exist_ok=True)
        path.write_text(text, "utf-8")
