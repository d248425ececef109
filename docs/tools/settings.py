"""Write the reference pages of settings, experiments and protocols from their files.

``python -m docs.tools.settings`` writes them; a test fails if they are out of date.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
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
from tangent_train.results.published import facts, protocols, published_lines

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
        "protocols.md": map(_protocol, protocols()),
    }
    return {REFERENCE / name: _below_head(name, parts) for name, parts in generated.items()}


def _below_head(name: str, parts: Iterable[str]) -> str:
    """Return a page with new text below its mark; the text above is written by hand."""
    head = (REFERENCE / name).read_text("utf-8").partition(_MARK)[0]
    return head + _MARK + "\n" + "\n".join(parts)


def _protocol(name: str) -> str:
    entry = protocols()[name]
    run = f"\n\n`experiment={entry['experiment']}`" if "experiment" in entry else ""
    ordered = sorted(facts(name).items(), key=lambda fact: fact[0] not in ("data", "classes"))
    listed = [f"| `{fact}` | {value} |" for fact, value in ordered]
    lines = [line for line in published_lines() if line["protocol"] == name and line["mean"]]
    columns = ("method", "stage", "trained_on", "level", "inputs", "fold", "score", "mean")
    shown = [column for column in columns if any(line[column] for line in lines)]
    rows = [
        f"| {' | '.join(line[c] or '–' for c in shown)} | <{line['source']}> |" for line in lines
    ]
    head = [*(column.replace("_", " ") for column in shown), "source"]
    table = [f"| {' | '.join(head)} |", f"| {' | '.join('---' for _ in head)} |", *rows]
    text = f"## {name}\n\n{entry['about']}{run}\n\n| fact | value |\n| --- | --- |\n"
    return text + "\n".join([*listed, "", *(table if lines else ["No score is published."]), ""])


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
