"""Write the reference pages of settings, experiments and protocols from their files.

``python -m docs.tools.settings`` writes them; a test fails if they are out of date.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Mapping
from itertools import chain
from pathlib import Path
from typing import Any

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
COMMANDS = {
    "train": ("train", "evaluate", "transfer", "prepare", "check"),
    "predict": ("predict",),
    "import": ("import", "export"),
    "render": ("render",),
    "keypoints": ("keypoints",),
}
"""Commands by the page of their settings; the commands of a page share settings."""

GROUPS = {
    "data": ("data",),
    "networks": ("representation", "network"),
    "runs": ("task", "optimizer", "scheduler", "trainer", "logger", "callbacks", "recipe",
             "debug", "sweep", "launcher"),
}  # fmt: skip
"""Groups by the page of their settings."""

_PAGE_OF = {group: page for page, groups in GROUPS.items() for group in groups}
_EXPERIMENTS = ("| experiment | content |", "| --- | --- |")
_MARK = "<!-- generated -->\n"


def pages() -> dict[Path, str]:
    """Return the generated pages by their paths."""
    generated: dict[str, Iterable[str]] = {
        f"settings/{page}.md": (f"# Settings of tangent-{page}\n", *map(_command, commands))
        for page, commands in COMMANDS.items()
    }
    for page, groups in GROUPS.items():
        title = f"# Settings of {page}\n"
        generated[f"settings/{page}.md"] = (title, *map(_group, groups))
    experiments = map(_experiment, sorted((CONFIGS / "experiment").rglob("*.yaml")))
    generated["experiments.md"] = (_below_head("experiments.md"), *_EXPERIMENTS, *experiments, "")
    data_sets = dict.fromkeys(facts(name)["data"] for name in protocols())
    generated["protocols.md"] = (_below_head("protocols.md"), *map(_data_set, data_sets))
    return {REFERENCE / name: "\n".join(parts) for name, parts in generated.items()}


def _below_head(name: str) -> str:
    """Return the text of a page above its mark, which is written by hand, and the mark."""
    return (REFERENCE / name).read_text("utf-8").partition(_MARK)[0] + _MARK


def _data_set(data: str) -> str:
    """Return the section of a data set: the facts of its protocols, and notes on them."""
    found = {name: facts(name) for name in protocols() if facts(name)["data"] == data}
    counts = Counter(fact for of in found.values() for fact in of.items())
    usual = dict(fact for fact, count in counts.items() if count > max(1, len(found) / 2))
    rows, notes = [], []
    for name, of in found.items():
        entry = protocols()[name]
        run = f"`{entry['experiment']}`" if "experiment" in entry else "–"
        every = dict.fromkeys(usual, "–") | of  # depth has no classes
        own = _facts({fact: value for fact, value in every.items() if usual.get(fact) != value})
        rows.append(f"| `{name}` | {own} | {run} |")
        notes += [f"* `{name}`: {entry['about']}"] if "about" in entry else []
    start = f"Unless a row states other values: {_facts(usual)}.\n\n" if usual else ""
    table = ["| protocol | facts | experiment |", "| --- | --- | --- |", *rows, ""]
    return f"## {data}\n\n{start}" + "\n".join([*table, *notes, ""])


def _facts(values: Mapping[str, str]) -> str:
    return "; ".join(f"`{name}` {value}" for name, value in values.items() if name != "data")


def _command(name: str) -> str:
    file = CONFIGS / f"{name}.yaml"
    settings, note = command_settings(name), ""
    if name != "train" and issubclass(SETTINGS[name], RunSettings):
        of_training = command_settings("train")
        settings = [setting for setting in settings if setting not in of_training]
        note = "It has the settings of [tangent-train](train.md#tangent-train), "
        note += f"except for `init_from` and `resume`{', with:' if settings else '.'}\n\n"
    return f"## tangent-{name}\n\n{_text(description(file)[0])}\n\n{note}{_table(settings)}"


def _group(name: str) -> str:
    """Return the options of a group; settings of several options are described once, first."""
    files = sorted((CONFIGS / name).glob("*.yaml"))
    listed = {file: [s for s in read_settings(file) if _is_shown(s)] for file in files}
    values: dict[tuple[str, str], Counter[str]] = {}
    for setting in chain.from_iterable(listed.values()):
        values.setdefault((setting.name, setting.comment), Counter())[setting.value] += 1
    common = {
        key: Setting(key[0], counts.most_common(1)[0][0], key[1])
        for key, counts in sorted(values.items())
        if counts.total() > 1
    }
    shared = f"Settings of several options:\n\n{_table(common.values())}" if common else ""
    options = [_option(file, settings, common) for file, settings in listed.items()]
    return "\n".join([f"## {name}\n", shared, *options])


def _option(file: Path, settings: list[Setting], common: Mapping[Any, Setting]) -> str:
    names = [f"`{file.parent.name}={name}`" for group, _, name in bases(file) if not group]
    notes = [f"Based on {' and '.join(names)}."] if names else []
    used = [(setting, common.get((setting.name, setting.comment))) for setting in settings]
    also = [
        f"`{setting.name}`" if setting == usual else _value(f"{setting.name}={setting.value}")
        for setting, usual in used
        if usual
    ]
    notes += [f"Settings described above: {', '.join(also)}."] if also else []
    table = _table(setting for setting, usual in used if not usual)
    parts = [f"### {file.parent.name}={file.stem}", _prose(file), " ".join(notes), table.rstrip()]
    return "\n\n".join(filter(None, parts)) + "\n"


def _experiment(file: Path) -> str:
    name = file.relative_to(CONFIGS / "experiment").with_suffix("").as_posix()
    about = re.split(r"(?<! al)\.(?: |$)", " ".join(description(file)))[0]
    return f"| `{name}` | {_text(about, '../')} |"


def _is_shown(setting: Setting) -> bool:
    return bool(setting.value) and not setting.name.endswith(("_target_", "_partial_"))


def _table(settings: Iterable[Setting]) -> str:
    rows = [
        f"| {_name(s.name)} | {_value(s.value)} | {_text(s.comment)} |"
        for s in settings
        if s.value or s.comment
    ]
    head = ["| setting | default | meaning |", "| --- | --- | --- |"]
    return "\n".join([*head, *rows, ""]) if rows else ""


def _name(name: str) -> str:
    group = name.rpartition(".")[2]
    return f"[`{name}`]({_PAGE_OF[group]}.md#{group})" if group in _PAGE_OF else f"`{name}`"


def _value(written: str) -> str:
    code = " ".join(written.split()).replace("|", "\\|")
    return f"`{code}`" if code else ""


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
