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
COMMANDS = ("train", "evaluate", "predict", "import", "export", "render", "transfer", "keypoints",
            "prepare", "check")  # fmt: skip
GROUPS = ("data", "representation", "network", "task", "optimizer", "scheduler", "trainer",
          "logger", "callbacks", "recipe", "debug", "sweep", "launcher")  # fmt: skip
_SETTINGS = """# Settings

Every setting of every command, generated from their declarations and from the config files.
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

_PROTOCOLS = """# Protocols

A protocol is the set of facts that decide which scores can be compared. Every run derives its facts
from its data set, its settings and its task, prints them below the scores and stores them in
[results.json](file_formats.md#resultsjson). `tangent-report` and `results.md` show a published
score beside a result if all facts are the same, and name the facts in which the nearest other
protocols differ. Different data sets are not compared.

| fact | meaning |
| --- | --- |
| `data` | class of the data set |
| `size` | width × height of the panorama whose pixels are scored; of photos, the crops |
| `area` | part of the sphere: west, east, south and north in degrees; none is the whole sphere |
| `unknown` | black pixels that are unknown too, see `data.unknown` |
| `mask` | further ignored pixels, see `data.mask` |
| `test_rotation` | rotation of the test images, see `data.test_rotation` |
| `classes` | set of classes: their number, or a name, see `data.classes` |
| `absent_class` | IoU of classes absent from the labels: not in the mean (`skip`) or 0 (`zero`) |
| `alignment` | of depth: alignment with the true distances, in distance or disparity |
| `range` | of depth: true distances that count, and whether predictions are clipped to them |
| `views_aligned` | of depth of panoramas: alignment of the views with each other; not compared |
| `images` | number of test images, if some are missing or were left out as broken: `2 of 100` |
| `weighting` | `pixels`: the pixels of all images count equally; the mean is over classes |
| | `pixels, then images`: the mean over the pixels of each image, then over the images |

Further facts are settings of single data sets. Folds are compared separately. "Not stated" is a
fact that the source does not state: such scores stand beside no result. Reasons are on the page
[Comparison](../explanation/comparison.md#published-scores), commands on the page
[Benchmarks of the field](../how-to/field_benchmarks.md).

This page is generated from `protocols.yaml` and `published.csv` in `tangent_train/results`.
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
        REFERENCE / "protocols.md": "\n".join([_PROTOCOLS, *map(_protocol, protocols())]),
    }


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
