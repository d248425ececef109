"""Every command in README and docs is run, as it is written, on small files that it could mean.

`documentation/world.py` has the files, `documentation/small.py` what stands in for placeholders and
the settings that are appended. A command that neither knows fails here, by its file and line.
"""

from __future__ import annotations

import os
import re
import shlex
import shutil
import tomllib
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from tests.slow.documentation.before import made_first, make_way, needs_its_block
from tests.slow.documentation.markdown import (
    SHELLS,
    Command,
    blocks,
    commands,
    documents,
    shown_files,
)
from tests.slow.documentation.running import ROOT, run
from tests.slow.documentation.small import NoStandInError, small_settings, stand_in
from tests.slow.documentation.world import CLUSTER, INSTALLED, build_world

if TYPE_CHECKING:
    from tests.conftest import FabricateStanford

TEXTS = {path.relative_to(ROOT).as_posix(): path.read_text() for path in documents(ROOT)}
COMMANDS = [command for name, text in TEXTS.items() for command in commands(name, text)]
RUN = ("tangent-", "python")
LEFT = {
    "tangent-train": "results.json",
    "tangent-evaluate": "results.json",
    "tangent-transfer": "*.md",
    "tangent-report": "report.md",
}
"""What a command leaves that was not there."""


def _once(found: list[Command]) -> list[Command]:
    """Those to be run; what several documents say alike only once."""
    kept: dict[tuple[object, ...], Command] = {}
    for command in found:
        if command.program.startswith(RUN):
            own = command.document if "--config-dir" in command.words else ""
            kept.setdefault((own, command.words), command)
    return list(kept.values())


@pytest.fixture(scope="module")
def template(
    tmp_path_factory: pytest.TempPathFactory, fabricate_stanford: FabricateStanford
) -> Path:
    return build_world(tmp_path_factory.mktemp("documentation") / "world", fabricate_stanford)


@pytest.fixture
def world(template: Path, tmp_path: Path) -> Path:
    """A copy of it that a command may change."""
    return Path(shutil.copytree(template, tmp_path / "world"))


def _write_shown_files(document: str, folder: Path) -> None:
    for name, content in shown_files(TEXTS[document]).items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(content)


def _variables(command: Command, world: Path) -> dict[str, str]:
    variables = {"PYTHONPATH": INSTALLED}
    if any("slurm" in word for word in command.words):
        variables["PATH"] = f"{world / CLUSTER}:{os.environ['PATH']}"
    return variables | dict(command.variables)


def _times(folder: Path, pattern: str) -> dict[Path, int]:
    return {path: path.stat().st_mtime_ns for path in folder.rglob(pattern)}


def _check(command: Command, world: Path) -> None:
    """Run it, and before it what it goes on from."""
    words = stand_in(command, world)
    if needs_its_block(words, world):
        for other in COMMANDS:
            if (other.document, other.block) == (command.document, command.block or -1):
                if other.line >= command.line:
                    break
                _check(other, world)
    for first in made_first(words, world):
        assert run(first, {}, world).status == 0, f"{command}: {shlex.join(first)}"
    make_way(words, world)
    words += small_settings(words, world)
    pattern = LEFT.get(command.program, "*")
    before = _times(world, pattern)
    done = run(words, _variables(command, world), world)
    told = f"{command}\nwas run as: {shlex.join(words)}\n{done.output}"
    assert done.status == 0, told
    assert "Traceback" not in done.output, told
    if command.program in LEFT and "--help" not in words:
        assert _times(world, pattern) != before, f"no {pattern} of {told}"


@pytest.mark.slow
@pytest.mark.parametrize("command", _once(COMMANDS), ids=str)
def test_every_command_runs(command: Command, world: Path) -> None:
    _write_shown_files(command.document, world)
    _check(command, world)


PYTHON = {
    f"{name}:{block.line}": (name, block.text)
    for name, text in TEXTS.items()
    for block in blocks(text)
    if block.language == "python" and block.file is None
}


@pytest.mark.slow
@pytest.mark.parametrize("place", PYTHON)
def test_python_in_the_documents_runs(place: str, world: Path) -> None:
    document, text = PYTHON[place]
    _write_shown_files(document, world)
    (world / "documented.py").write_text(text)
    done = run(["python", "documented.py"], {"PYTHONPATH": INSTALLED}, world)
    assert done.status == 0, f"{place}\n{done.output}"


@pytest.mark.parametrize("command", [c for c in COMMANDS if not c.program.startswith(RUN)], ids=str)
def test_what_is_not_run_here_exists(command: Command) -> None:
    """Targets of make are run by CI, what pip installs by everybody who sets this up."""
    program, *arguments = command.words
    if program == "make":
        targets = re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
        assert arguments
        assert set(arguments) <= set(targets)
        return
    assert (program, arguments[0]) == ("pip", "install"), f"nothing tests {command}"
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    wanted = re.fullmatch(rf"{project['name']}(?:\[([a-z,]+)\])?", arguments[-1])
    assert wanted, f"{command}: not {project['name']} or one of its extras"
    extras = wanted[1].split(",") if wanted[1] else []
    assert set(extras) <= set(project["optional-dependencies"])


def test_commands_stand_in_shell_blocks_only() -> None:
    """In others they would not be found."""
    hidden = [
        f"{name}:{block.line}"
        for name, text in TEXTS.items()
        for block in blocks(text)
        if block.language not in (*SHELLS, "python", "yaml")
        and re.search(r"^(?:\$ )?(?:tangent-[a-z]+|python|pip|make) ", block.text, re.MULTILINE)
    ]
    assert not hidden


EXAMPLE = """
Type `tangent-train resume=<run folder>`, or `make all`; `tangent-report` is a name.

```bash
export LEVEL=7 THREADS=1
FAST=yes tangent-train -m a=1,2 \\
    'b=[c, d]'   # and a comment
# tangent-train nothing
tangent-predict input='my #1.jpg'
```

   ```sh
   $ make install
   ```

```yaml
# my_configs/x.yaml
a: `tangent-train b=c`
```
"""


def test_commands_are_found_as_a_shell_would_read_them() -> None:
    exported = (("LEVEL", "7"), ("THREADS", "1"))
    assert commands("x.md", EXAMPLE) == [
        Command("x.md", 2, ("tangent-train", "resume=<run folder>")),
        Command("x.md", 2, ("make", "all")),
        Command(
            "x.md", 6, ("tangent-train", "-m", "a=1,2", "b=[c, d]"), (*exported, ("FAST", "yes")), 5
        ),
        Command("x.md", 9, ("tangent-predict", "input=my #1.jpg"), exported, 5),
        Command("x.md", 13, ("make", "install"), (), 13),
    ]
    assert shown_files(EXAMPLE) == {
        "my_configs/x.yaml": "# my_configs/x.yaml\na: `tangent-train b=c`\n"
    }


def test_placeholders_become_what_is_there(tmp_path: Path) -> None:
    (tmp_path / "runs" / "demo" / "later").mkdir(parents=True)
    (tmp_path / "runs" / "demo" / "later" / "x.ckpt").touch()
    words = ("tangent-x", "experiment=…", "a=runs/demo/…/x.ckpt", "data.root=/data/2d3ds/sub", "…")
    assert stand_in(Command("x.md", 1, words), tmp_path) == [
        "tangent-x",
        "experiment=rooms/demo",
        "a=runs/demo/later/x.ckpt",
        f"data.root={tmp_path}/2d3ds/sub",
    ]


@pytest.mark.parametrize("word", ["unheard=…", "a=<file>", "a=runs/…/none", "/unheard/of", "x<y>"])
def test_what_nothing_stands_in_for_is_named(word: str, tmp_path: Path) -> None:
    with pytest.raises(NoStandInError, match=r"^x\.md:3 tangent-train"):
        stand_in(Command("x.md", 3, ("tangent-train", word)), tmp_path)
    with pytest.raises(NoStandInError, match="no rule that makes tangent-dance small"):
        small_settings(["tangent-dance", "a=1"], tmp_path)


@pytest.mark.slow
def test_a_command_that_fails_is_seen(template: Path) -> None:
    done = run(["tangent-train", "data.fold=1", "nonsense=1"], {}, template)
    assert done.status == 1
    assert "unknown setting: found 'nonsense'" in done.output
