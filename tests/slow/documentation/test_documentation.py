"""Every command and Python program of README and docs is run on small data.

A command that names a file or placeholder that is not known here fails with its line: `world.py`
has the files, `commands.py` what stands in for placeholders and the settings that make runs small.
"""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

from tests.slow.documentation.commands import Block, find_blocks, split_line
from tests.slow.documentation.world import ROOT, build_world, run

BLOCKS = [
    block
    for path in (ROOT / "README.md", *sorted((ROOT / "docs").glob("**/*.md")))
    for block in find_blocks(path.relative_to(ROOT).as_posix(), path.read_text())
]


@pytest.fixture(scope="session")
def template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build_world(tmp_path_factory.mktemp("documentation"))


@pytest.mark.timeout(1500)
@pytest.mark.parametrize("block", BLOCKS, ids=lambda block: block.location)
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
