"""Write the reference pages of settings and experiments from the config files.

``python -m docs.tools.settings`` writes them; a test fails if they are out of date.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

from tangent_train.cli.compose import config_folder
from tangent_train.cli.help import Setting, bases, description, read_settings

CONFIGS = config_folder()
REFERENCE = Path(__file__).parents[1] / "reference"
COMMANDS = ("train", "evaluate", "predict", "import", "export", "render", "transfer", "keypoints",
            "prepare", "check")  # fmt: skip
GROUPS = ("data", "representation", "network", "task", "optimizer", "scheduler", "trainer",
          "logger", "callbacks", "recipe", "debug", "sweep", "launcher")  # fmt: skip
_SETTINGS = """# Settings

Every setting of every command, generated from the config files and their comments.
`<command> --help` prints the same comments.

Settings are given as `name=value`, e.g. `tangent-train level=6 trainer.max_epochs=3`. A *group*
is a setting whose value is the name of an option, e.g. `data=folder`. The settings of the option
then begin with the name of the group, e.g. `data.root=my_rooms`. `${name}` is the value of another
setting.

Stored combinations of options and values are on the page [Experiments](experiments.md).
"""
_REPORT = """### tangent-report

`tangent-report <run>` has options instead of settings: see `tangent-report --help`.
"""
_EXPERIMENTS = """# Experiments

An experiment is a file with options and values, chosen by `experiment=<name>`. Settings on the
command line override it. This page is generated from the files in `configs/experiment/`. The
meanings of the settings are on the page [Settings](settings.md).
"""


def pages() -> dict[Path, str]:
    """Return the generated pages by their paths."""
    settings = [_SETTINGS, "## Commands\n", *map(_command, COMMANDS), _REPORT, "## Groups\n"]
    for group in GROUPS:
        settings += [f"### {group}\n", *map(_option, sorted((CONFIGS / group).glob("*.yaml")))]
    experiments = map(_experiment, sorted((CONFIGS / "experiment").rglob("*.yaml")))
    return {
        REFERENCE / "settings.md": "\n".join(settings),
        REFERENCE / "experiments.md": "\n".join([_EXPERIMENTS, *experiments]),
    }


def _command(name: str) -> str:
    file = CONFIGS / f"{name}.yaml"
    settings = [s for s in read_settings(file) if not s.name.startswith("hydra")]
    names = [f"[tangent-{base}](#tangent-{base})" for base in _bases(file)]
    note = _based_on("It has the settings of", names, settings)
    return f"### tangent-{name}\n\n{_text(description(file)[0])}\n\n{note}{_table(settings)}"


def _option(file: Path) -> str:
    settings = [s for s in read_settings(file) if not s.name.endswith(("_target_", "_partial_"))]
    names = [f"`{file.parent.name}={base}`" for base in _bases(file)]
    note = _based_on("Based on", names, settings)
    return f"#### {file.parent.name}={file.stem}\n\n{_prose(file)}\n\n{note}{_table(settings)}"


def _experiment(file: Path) -> str:
    name = file.relative_to(CONFIGS / "experiment").with_suffix("").as_posix()
    content = re.sub(r"\A(#.*\n)+", "", file.read_text("utf-8")).strip()
    return f"## {name}\n\n{_prose(file)}\n\n```yaml\n{content}\n```\n"


def _bases(file: Path) -> list[str]:
    return [name for group, _, name in bases(file) if not group]


def _based_on(start: str, names: list[str], settings: list[Setting]) -> str:
    if not names:
        return ""
    return f"{start} {' and '.join(names)}{', with:' if settings else '.'}\n\n"


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
