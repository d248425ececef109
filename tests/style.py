"""Check the wording of the product: `python -m tests.style [PATH …]` prints a line per finding.

Without a path, the whole product is read. The rules are in `tests.style_rules`.
"""

from __future__ import annotations

import ast
import io
import re
import sys
import tokenize
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from tests.style_rules import (
    COMMENT,
    DOCSTRING,
    ENTRY,
    MESSAGE,
    NAME,
    PAGE,
    RULES,
    SETTING,
    TEST_NAME,
    VALUE,
)

ROOT = Path(__file__).parents[1]
SUFFIXES = {".py", ".md", ".yaml"}
EXAMPLES = {"tests/style_rules.py", "tests/test_style.py"}
PRODUCT = (
    "README.md",
    "CONTRIBUTING.md",
    "CHANGELOG.md",
    "docs",
    "configs",
    "tangent_train",
    "datamodules",
    "models",
    "studies",
    "benchmarks",
    "tests",
)

SECTION = re.compile(r"(Args|Attributes|Returns|Yields):\Z")
NAMED_ENTRY = re.compile(r"\*{0,2}`*\w[\w, .*/`]*(?: \([^)]*\))?: (.+)\Z")
DIRECTIVE = re.compile(r"#\s*(?:noqa|type:|pragma|fmt:|mypy:|!)")


@dataclass(frozen=True)
class Text:
    """A piece of a file that a person reads."""

    path: str
    line: int
    kind: str
    content: str


def read_texts(path: str, source: str) -> Iterator[Text]:
    """Yield the texts of a file.

    Args:
        path: Its path, which decides how it is read.
        source: Its content.
    """
    suffix = Path(path).suffix
    if suffix == ".py":
        yield from _python_texts(path, source)
    elif suffix == ".md":
        yield from _page_texts(path, source)
    elif suffix == ".yaml":
        yield from _setting_texts(path, source)


def find(texts: Iterable[Text]) -> Iterator[str]:
    """Yield ``path:line: rule: text`` for each place where a rule applies."""
    for text in texts:
        shown = (
            _blank_code(text.content) if text.kind not in (NAME, VALUE, TEST_NAME) else text.content
        )
        for rule in RULES:
            if text.kind not in rule.kinds:
                continue
            for match in rule.expression.finditer(shown):
                line = text.line + shown.count("\n", 0, match.start())
                excerpt = " ".join(shown[max(match.start() - 30, 0) : match.end() + 30].split())
                yield f"{text.path}:{line}: {rule.name}: {excerpt!r} ({rule.advice})"


def find_in(paths: Iterable[str]) -> list[str]:
    """Return the findings in files and folders, relative to the repository."""
    findings: list[str] = []
    for path in list_files(paths):
        if path not in EXAMPLES:
            findings += find(read_texts(path, (ROOT / path).read_text(encoding="utf-8")))
    return findings


def list_files(paths: Iterable[str]) -> list[str]:
    """Return the Python files, pages and configs among files and in folders."""
    found = set()
    for path in map(Path, paths):
        inside = (ROOT / path).rglob("*") if (ROOT / path).is_dir() else [ROOT / path]
        found |= {file.relative_to(ROOT).as_posix() for file in inside if file.suffix in SUFFIXES}
    return sorted(found)


def _python_texts(path: str, source: str) -> Iterator[Text]:
    """Yield docstrings, comments, messages and names of a Python file."""
    tree = ast.parse(source)
    documented = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            if (
                isinstance(node, ast.FunctionDef)
                and node.name.startswith("test_")
                and path.startswith("tests/")
            ):
                words = node.name.removeprefix("test_").replace("_", " ")
                yield Text(path, node.lineno, TEST_NAME, words)
            first = node.body[0] if node.body else None
            if (
                isinstance(first, ast.Expr)
                and isinstance(first.value, ast.Constant)
                and isinstance(first.value.value, str)
            ):
                documented.add(first.value)
                yield from _docstring_texts(path, first.lineno, first.value.value)
    for node in ast.walk(tree):
        if (
            isinstance(node, ast.Constant)
            and isinstance(node.value, str)
            and node not in documented
        ):
            kind = MESSAGE if " " in node.value.strip() else VALUE
            yield Text(path, node.lineno, kind, node.value)
    yield from _token_texts(path, source)


def _docstring_texts(path: str, line: int, content: str) -> Iterator[Text]:
    """Yield a docstring and the descriptions of its arguments and results."""
    lines = [
        row.strip() if not row.lstrip().startswith(">>>") else "" for row in content.split("\n")
    ]
    yield Text(path, line, DOCSTRING, "\n".join(lines))
    indents = [len(row) - len(row.lstrip()) for row in content.split("\n")]
    section, depth, is_first = "", 0, False
    for number, row in enumerate(lines):
        if match := SECTION.match(row):
            section, depth, is_first = match[1], indents[number], True
        elif row and indents[number] <= depth:
            section = ""
        elif row and section in ("Returns", "Yields") and is_first:
            yield Text(path, line + number, ENTRY, row)
            is_first = False
        elif (
            section in ("Args", "Attributes")
            and indents[number] == depth + 4
            and (match := NAMED_ENTRY.match(row))
        ):
            yield Text(path, line + number, ENTRY, match[1])


def _token_texts(path: str, source: str) -> Iterator[Text]:
    """Yield comments, those on successive lines as one, and each name where it first occurs."""
    names: set[str] = set()
    block: list[str] = []
    last, column = 0, 0
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.NAME and token.string not in names:
            names.add(token.string)
            if not token.string.startswith("test_"):
                yield Text(path, token.start[0], NAME, token.string)
        elif token.type == tokenize.COMMENT and not DIRECTIVE.match(token.string):
            if block and token.start != (last + 1, column):
                yield Text(path, last - len(block) + 1, COMMENT, "\n".join(block))
                block = []
            block.append(token.string.lstrip("# "))
            last, column = token.start
    if block:
        yield Text(path, last - len(block) + 1, COMMENT, "\n".join(block))


def _setting_texts(path: str, source: str) -> Iterator[Text]:
    """Yield the comments of a YAML file, each line as one text."""
    for number, row in enumerate(source.split("\n"), start=1):
        if match := re.search(r"(?:^|\s)#\s*(.*)", row):
            yield Text(path, number, SETTING, match[1])


def _page_texts(path: str, source: str) -> Iterator[Text]:
    """Yield the paragraphs of a Markdown page, without blocks of code and addresses of links."""
    block: list[str] = []
    is_code = False
    rows = source.split("\n")
    for number, row in enumerate([*rows, ""], start=1):
        is_fence = row.lstrip().startswith(("```", "~~~"))
        if is_fence or is_code or not row.strip():
            if block:
                yield Text(path, number - len(block), PAGE, "\n".join(block))
                block = []
            is_code = is_code != is_fence
        else:
            block.append(re.sub(r"\]\([^)]*\)", "]", row.strip()))


def _blank_code(text: str) -> str:
    """Replace code in backticks by underscores and keep the lines."""
    return re.sub(
        r"(`+).+?\1", lambda match: re.sub(r"[^\n]", "_", match[0]), text, flags=re.DOTALL
    )


if __name__ == "__main__":
    found = find_in(sys.argv[1:] or PRODUCT)
    sys.stdout.write("".join(f"{finding}\n" for finding in found))
    sys.exit(bool(found))
