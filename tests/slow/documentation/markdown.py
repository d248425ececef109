"""What README and docs tell a reader to type: commands, files to write, Python to run."""

from __future__ import annotations

import re
import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator

SHELLS = ("bash", "sh", "shell", "console")
PROGRAMS = ("tangent-", "python ", "python3 ", "pip ", "make ")
"""What a code span in a text begins with to be a command."""

_FENCE = re.compile(r"^( *)```+(\S*)\s*$")
_SPAN = re.compile(r"(?<!`)`([^`]+)`(?!`)")
_VARIABLE = re.compile(r"[A-Za-z_][A-Za-z_0-9]*=.*")
_FILE = re.compile(r"^(?:#|//) (\S+\.\w+)$")
_OPEN = re.compile(r"<[^<>]*>")


@dataclass(frozen=True)
class Command:
    """A command line as a reader would type it.

    Attributes:
        document: Path of the file from the project's root.
        line: Of its first word, from 1.
        words: Program and arguments, quotes and comments gone.
        variables: Environment variables set before the program.
        block: The line that its block begins in; 0 for those in a text.
    """

    document: str
    line: int
    words: tuple[str, ...]
    variables: tuple[tuple[str, str], ...] = ()
    block: int = 0

    @property
    def program(self) -> str:
        return self.words[0] if self.words else ""

    def __str__(self) -> str:
        return f"{self.document}:{self.line} {shlex.join(self.words)}"


@dataclass(frozen=True)
class Block:
    """A fenced block.

    Attributes:
        language: After the fence; empty without one.
        line: Of its first line of text, from 1.
        text: Its lines, without the fence's indentation.
    """

    language: str
    line: int
    text: str

    @property
    def file(self) -> str | None:
        """The file that it shows: its first line is a comment that is only a path."""
        found = _FILE.match(self.text.partition("\n")[0])
        return None if found is None else found[1]


def blocks(text: str) -> list[Block]:
    """All fenced blocks of a Markdown text."""
    found: list[Block] = []
    inside: tuple[int, str, int, list[str]] | None = None
    for number, line in enumerate(text.splitlines(), start=1):
        fence = _FENCE.match(line)
        if inside is None:
            inside = (len(fence[1]), fence[2], number + 1, []) if fence else None
        elif fence and not fence[2]:
            found.append(Block(inside[1], inside[2], "\n".join(inside[3]) + "\n"))
            inside = None
        else:
            inside[3].append(line[inside[0] :])
    assert inside is None, f"a block that begins in line {inside and inside[2]} has no end"
    return found


def commands(document: str, text: str) -> list[Command]:
    """All commands of a Markdown text: of its shell blocks, and code spans that have arguments."""
    found = [
        command
        for block in blocks(text)
        if block.language in SHELLS
        for command in _of_block(document, block)
    ]
    return sorted([*found, *_of_spans(document, text)], key=lambda command: command.line)


def _of_block(document: str, block: Block) -> Iterator[Command]:
    variables: tuple[tuple[str, str], ...] = ()
    for line, text in _joined(block):
        words = _words(text.removeprefix("$ "))
        command = _command(document, line, words, variables, block.line)
        if command.program == "export":  # holds for the commands below it
            variables += tuple(_pair(word) for word in command.words[1:])
        elif command.words:
            yield command


def _joined(block: Block) -> Iterator[tuple[int, str]]:
    """Lines with those that continue them, and the number of the first."""
    start = block.line
    parts: list[str] = []
    for number, text in enumerate(block.text.splitlines(), start=block.line):
        start = start if parts else number
        parts.append(text.removesuffix("\\"))
        if not text.endswith("\\"):
            yield start, " ".join(parts)
            parts = []
    assert not parts, f"line {start} goes on and the block ends"


def _of_spans(document: str, text: str) -> Iterator[Command]:
    # Blocks become empty lines: their backticks are no code spans, lines keep their numbers.
    for block in blocks(text):
        text = text.replace(block.text, "\n" * block.text.count("\n"), 1)
    text = "\n".join("" if _FENCE.match(line) else line for line in text.split("\n"))
    for span in _SPAN.finditer(text):
        if span[1].startswith(PROGRAMS) and len(span[1].split()) > 1:
            line = text.count("\n", 0, span.start()) + 1
            yield _command(document, line, _words(span[1]))


def _words(text: str) -> list[str]:
    """As a shell reads them; a placeholder such as <run folder> is part of one word."""
    together = _OPEN.sub(lambda found: found[0].replace(" ", "\xa0"), text)
    return [word.replace("\xa0", " ") for word in shlex.split(together, comments=True)]


def _command(
    document: str,
    line: int,
    words: list[str],
    variables: tuple[tuple[str, str], ...] = (),
    block: int = 0,
) -> Command:
    own = 0
    while own < len(words) and _VARIABLE.fullmatch(words[own]):
        own += 1
    pairs = (*variables, *(_pair(word) for word in words[:own]))
    return Command(document, line, tuple(words[own:]), pairs, block)


def _pair(word: str) -> tuple[str, str]:
    name, _, value = word.partition("=")
    return name, value


def shown_files(text: str) -> dict[str, str]:
    """Files that a Markdown text shows, by their paths."""
    return {block.file: block.text for block in blocks(text) if block.file is not None}


def documents(root: Path) -> list[Path]:
    """README and docs."""
    return [root / "README.md", *sorted((root / "docs").glob("**/*.md"))]
