"""Every figure has one home: a CSV file in ``docs/results/data``.

A comment before a table or paragraph names the file: ``<!-- data: demo.csv -->``. A table of a
results page has rows and columns of its file, and every file is shown or linked. In README.md
and the paper's experiments, a table or paragraph with a score names one or more files, and its
figures are found in them; ``published.csv`` is in `tangent_train.results`.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator
from pathlib import Path
from statistics import fmean
from typing import NamedTuple

import pytest

from tangent_train.results.published import published_lines

ROOT = Path(__file__).resolve().parents[2]
RESULTS = ROOT / "docs" / "results"
DATA = RESULTS / "data"

MARK = re.compile(r"<!-- data: (.+?) -->")
SCORE = re.compile(r"\bmIoU\b|\bmAcc\b")
FIGURE = re.compile(r"(?<![\w.,])\d+\.\d(?![\w.])")


class Block(NamedTuple):
    """Lines between empty lines, and the data files that the comment before them names."""

    text: str
    files: list[str]


def blocks(page: str) -> Iterator[Block]:
    """Yield the tables, paragraphs and lists of a page.

    Args:
        page: Markdown. Blocks of code are skipped.
    """
    files: list[str] = []
    for text in re.split(
        r"\n\s*\n", re.sub(r"^```.*?^```", "", page, flags=re.DOTALL | re.MULTILINE)
    ):
        marks = MARK.findall(text)
        files = marks[-1].split() if marks else files
        content = MARK.sub("", text).strip()
        if content:
            yield Block(content, files)
            files = []


def plain(cell: str) -> str:
    """Return a cell without bold type, code marks, links and non-breaking spaces.

    Args:
        cell: Markdown.
    """
    cell = re.sub(r"\[(.+?)\]\([^)]*\)", r"\1", cell)
    return re.sub(r"\*\*|`", "", cell).replace("&nbsp;", "").replace(r"\|", "|").strip()


def table(text: str) -> list[list[str]]:
    """Return the plain cells of a Markdown table, header included.

    Args:
        text: Lines of the table.
    """
    lines = [line.strip() for line in text.splitlines()]
    rows = [re.split(r"(?<!\\)\|", line.strip("|")) for line in lines]
    return [[plain(cell) for cell in row] for row in (rows[0], *rows[2:])]


def cells(file: str) -> list[list[str]]:
    """Return the cells of a data file.

    Args:
        file: Name in ``docs/results/data``.
    """
    with (DATA / file).open(encoding="utf-8", newline="") as stream:
        return list(csv.reader(stream))


def tables(page: Path) -> Iterator[tuple[list[list[str]], list[str]]]:
    """Yield the cells and files of the tables of a page that hold figures.

    Args:
        page: Markdown file.
    """
    for text, files in blocks(page.read_text(encoding="utf-8")):
        if text.startswith("|"):
            rows = table(text)
            if any(re.match(r"[−-]?\d", cell) for row in rows[1:] for cell in row[1:]):
                yield rows, files


def published() -> list[list[str]]:
    """Return the published figures, one in each row, with the means over folds."""
    rows = [row for row in published_lines() if row["mean"]]
    folds: dict[tuple[str, ...], list[float]] = {}
    for row in rows:
        names = ("protocol", "stage", "method", "trained_on", "level", "base_level", "inputs")
        key = (*(row[name] for name in names), row["score"])
        folds.setdefault(key, []).append(float(row["mean"]))
    return [[row["mean"]] for row in rows] + [[f"{fmean(found):.1f}"] for found in folds.values()]


def is_found(figure: str, files: list[str]) -> bool:
    """Return True if a cell of the files contains a number.

    Args:
        figure: Number as printed.
        files: Names of data files.
    """
    number = re.compile(rf"(?<![\d.]){re.escape(figure)}(?![\d.])")
    tables = [published() if file == "published.csv" else cells(file) for file in files]
    return any(number.search(cell) for rows in tables for row in rows for cell in row)


PAGES = sorted(RESULTS.glob("*.md"))
LINK = re.compile(r"\]\(data/(\w+\.csv)\)")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_tables_of_results_are_in_their_data(page: Path) -> None:
    for (header, *rows), files in tables(page):
        assert len(files) == 1, f"no <!-- data: ….csv --> before the table {header}"
        names, *data = cells(files[0])
        columns = [names.index(name) for name in header]
        found = [[row[k] for k in columns] for row in data]
        assert [row for row in rows if row not in found] == []


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_results_state_when_they_were_measured(page: Path) -> None:
    first = page.read_text(encoding="utf-8").split("\n\n")[1]
    if page.stem == "index":
        assert "version" in first
    else:
        assert re.match(r"Measured on 20\d\d-\d\d-\d\d", first), first


def test_every_data_file_is_shown_or_linked() -> None:
    shown = {file for page in PAGES for _, files in tables(page) for file in files}
    linked = {file for page in PAGES for file in LINK.findall(page.read_text(encoding="utf-8"))}
    assert shown | linked == {path.name for path in DATA.glob("*.csv")}


@pytest.mark.parametrize("name", ["README.md", "docs/reference/experiments.md"])
def test_figures_outside_the_results_are_in_the_data(name: str) -> None:
    written = (ROOT / name).read_text(encoding="utf-8").partition("<!-- generated -->")[0]
    for text, files in blocks(written):
        if SCORE.search(text) or text.startswith("|") or files:
            prose = re.sub(r"`[^`]*`|\]\([^)]*\)", "", text)
            for figure in FIGURE.findall(prose):
                assert files, f"no <!-- data: ….csv --> before {text}"
                assert is_found(figure, files), f"{figure} is not in {files}: {text}"
