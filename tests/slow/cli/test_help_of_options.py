"""``--help`` explains every line, whatever option of a group is chosen."""

from __future__ import annotations

import pytest

from tests.cli.test_help import COMMANDS, CONFIGS, OPTIONS, explained
from tests.running import command_of

CHOICES = [
    ("train", f"{path.parent.name}={path.stem}")
    for path in OPTIONS
    if path.parent.name not in ("experiment", "launcher", "sweep")  # hydra.…, and experiments below
    and not path.stem.endswith("_pairs")
]
CHOICES += [("keypoints", f"data={path.stem}") for path in OPTIONS if path.stem.endswith("_pairs")]
for experiment in sorted((CONFIGS / "experiment").rglob("*.yaml")):
    name = experiment.relative_to(CONFIGS / "experiment").with_suffix("").as_posix()
    CHOICES.append((command_of(name), f"experiment={name}"))


@pytest.mark.parametrize("command", [path.stem for path in COMMANDS])
def test_help_of_a_command_explains_every_line(command: str) -> None:
    lines = explained(command).splitlines()
    assert [line for line in lines[1:] if " # " not in line] == []


@pytest.mark.parametrize(("command", "choice"), CHOICES)
def test_help_of_an_option_explains_every_line(command: str, choice: str) -> None:
    lines = explained(command, choice).splitlines()
    assert [line for line in lines[1:] if " # " not in line] == []
