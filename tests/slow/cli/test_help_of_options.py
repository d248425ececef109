"""``--help`` explains every line, whatever option of a group is chosen."""

from __future__ import annotations

import pytest

from tests.config.test_settings import CONFIGS, EXPERIMENTS, explained, unexplained
from tests.running import command_of

OPTIONS = sorted(CONFIGS.glob("*/*.yaml"))

CHOICES = [
    ("train", f"{path.parent.name}={path.stem}")
    for path in OPTIONS
    if path.parent.name not in ("experiment", "launcher", "sweep")  # hydra.…, and experiments below
    and not path.stem.endswith("_pairs")
]
CHOICES += [("keypoints", f"data={path.stem}") for path in OPTIONS if path.stem.endswith("_pairs")]
CHOICES += [(command_of(name), f"experiment={name}") for name in EXPERIMENTS]


@pytest.mark.parametrize(("command", "choice"), CHOICES)
def test_help_of_an_option_explains_every_line(command: str, choice: str) -> None:
    text = explained(command, choice)
    assert unexplained(text) == []
    assert max(map(len, text.splitlines())) <= 100
