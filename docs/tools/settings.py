"""Write the reference pages of settings, experiments and protocols from their files.

``python -m docs.tools.settings`` writes them; a test fails if they are out of date.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Mapping
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
GROUPS = ("data", "representation", "network", "task", "optimizer", "scheduler", "trainer",
          "logger", "callbacks", "recipe", "debug", "sweep", "launcher")  # fmt: skip
_MARK = "<!-- generated -->\n"


def pages() -> dict[Path, str]:
    """Return the generated pages by their paths."""
    settings = ["## Commands\n", *map(_command, SETTINGS), "## Groups\n"]
    for group in GROUPS:
        settings += [f"### {group}\n", *map(_option, sorted((CONFIGS / group).glob("*.yaml")))]
    experiments = map(_experiment, sorted((CONFIGS / "experiment").rglob("*.yaml")))
    generated = {
        "settings.md": settings,
        "experiments.md": experiments,
        "protocols.md": map(_data_set, dict.fromkeys(facts(name)["data"] for name in protocols())),
    }
    return {REFERENCE / name: _below_head(name, parts) for name, parts in generated.items()}


def _below_head(name: str, parts: Iterable[str]) -> str:
    """Return a page with new text below its mark; the text above is written by hand."""
    head = (REFERENCE / name).read_text("utf-8").partition(_MARK)[0]
    return head + _MARK + "\n" + "\n".join(parts)


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
        note = "It has the settings of [tangent-train](#tangent-train), except for `init_from` and "
        note += f"`resume`{', with:' if settings else '.'}\n\n"
    return f"### tangent-{name}\n\n{_text(description(file)[0])}\n\n{note}{_table(settings)}"


def _option(file: Path) -> str:
    settings = [s for s in read_settings(file) if not s.name.endswith(("_target_", "_partial_"))]
    names = [f"`{file.parent.name}={name}`" for group, _, name in bases(file) if not group]
    note = f"Based on {' and '.join(names)}{', with:' if settings else '.'}\n\n" if names else ""
    return f"#### {file.parent.name}={file.stem}\n\n{_prose(file)}\n\n{note}{_table(settings)}"


def _experiment(file: Path) -> str:
    name = file.relative_to(CONFIGS / "experiment").with_suffix("").as_posix()
    content = re.sub(r"\A(#.*\n)+", "", file.read_text("utf-8")).strip()
    return f"## {name}\n\n{_prose(file)}\n\n```yaml\n{content}\n```\n"


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
    return f"[`{name}`](#{group})" if group in GROUPS else f"`{name}`"


def _value(written: str) -> str:
    code = " ".join(written.split()).replace("|", "\\|")
    return f"`{code}`" if code else ""


def _prose(file: Path) -> str:
    return "\n".join(
        f"`{line.strip()}`" if line.startswith("  ") else _text(line) for line in description(file)
    )


def _text(comment: str) -> str:
    escaped = re.sub(r"([|<*\[\]])", r"\\\1", comment)
    return re.sub(r"docs/([\w/-]+\.md)", r"[\1](../\1)", escaped)


if __name__ == "__main__":
    for path, text in pages().items():
        path.write_text(text, "utf-8")
