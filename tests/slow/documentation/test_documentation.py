"""Commands of README and tutorials are run, and Python of guides; other commands are validated.

A command that names a file or placeholder that is not known here fails with its line: `world.py`
has the files, `commands.py` what stands in for placeholders and the settings that make runs small.
"""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

from tangent_train.config.settings import SETTINGS
from tests.running import composed_settings
from tests.slow.documentation.commands import Block, find_blocks, split_line
from tests.slow.documentation.world import ROOT, build_world, run, words_in_world

BLOCKS = [
    block
    for path in (ROOT / "README.md", *sorted((ROOT / "docs").glob("**/*.md")))
    for block in find_blocks(path.relative_to(ROOT).as_posix(), path.read_text())
]


RUN = [
    block
    for block in BLOCKS
    if block.location.startswith(("README", "docs/tutorials"))
    or (block.python and block.location.startswith("docs/how-to"))
]
OTHERS = [block for block in BLOCKS if block not in RUN and block.commands]
ELSEWHERE = ("hydra.", "launcher=", "sweep=")
READ_FILES = (
    "checkpoint",
    "predictions",
    "file",
    "init_from",
    "mask",
    "depth",
    "back",
    "poses",
    "align_across",
    "cameras",
    "classes",
)


@pytest.fixture(scope="session")
def template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build_world(tmp_path_factory.mktemp("documentation"))


@pytest.fixture(scope="session")
def validated(template: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy, into which the tests of settings write files that earlier commands would write."""
    return shutil.copytree(template, tmp_path_factory.mktemp("validated") / "world")


@pytest.mark.parametrize("block", OTHERS, ids=lambda block: block.location)
def test_documented_settings_are_valid(
    block: Block, validated: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    world = validated
    monkeypatch.chdir(world)
    for name, content in block.files.items():
        Path(name).parent.mkdir(parents=True, exist_ok=True)
        Path(name).write_text(content)
    for line in block.commands:
        _, words = split_line(line)
        command = words[0].removeprefix("tangent-") if words else ""
        if command not in SETTINGS or "--help" in words or any("resume=" in w for w in words):
            continue
        _, *arguments = words_in_world(words, world)
        overrides = [w for w in arguments if "=" in w and not w.startswith(ELSEWHERE)]
        for override in overrides:
            name, _, value = override.partition("=")
            if name in READ_FILES and not Path(value).exists():  # an earlier command writes it
                Path(value).parent.mkdir(parents=True, exist_ok=True)
                Path(value).touch()
        if "--config-dir" in arguments:
            folder = world / arguments[arguments.index("--config-dir") + 1]
            overrides.append(f"hydra.searchpath=[file://{folder}]")
        composed_settings(command, *overrides)


@pytest.mark.timeout(1500)
@pytest.mark.parametrize("block", RUN, ids=lambda block: block.location)
def test_documented_commands_run(block: Block, template: Path, tmp_path: Path) -> None:
    world = shutil.copytree(template, tmp_path / "world")
    for name, content in block.files.items():
        (world / name).parent.mkdir(parents=True, exist_ok=True)
        (world / name).write_text(content)
    if block.python:
        (world / "documented.py").write_text(block.python)
        run(["python", "documented.py"], {}, world)
    exported: dict[str, str] = {}
    for line in block.commands:
        variables, words = split_line(line)
        if not words:
            exported |= variables
        elif words[0] in ("cd", "git", "make", "pip", "python3", "source"):
            continue  # they set up; CI runs targets of make, and the tests need what pip installs
        elif words[0] in ("cp", "mkdir"):
            subprocess.run(words, check=True, cwd=world)
        else:
            run(words, exported | variables, world)
