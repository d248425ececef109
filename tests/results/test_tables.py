"""Tables show names of runs, classes and files as text, whatever they contain."""

from __future__ import annotations

import re
from dataclasses import replace
from html import unescape

import markdown  # type: ignore[import-untyped]
import pytest

from tangent_train.results.evaluation import result_tables
from tangent_train.results.tables import Table
from tests.results.example_results import example_result


@pytest.mark.parametrize(
    "name",
    [
        "<img src=x onerror=alert(1)>",
        "[run](javascript:alert(1))",
        r"[run\](javascript:alert(1))",
        "[run][1] and [1]: javascript:alert(1)",
        "a | b",
        "two\nlines",
        "45.6 [42.0, 50.0] & more",
    ],
)
def test_markdown_shows_names_as_text(name: str) -> None:
    """Python-Markdown, an independent implementation, finds the same text and no other element."""
    text = Table(name, ("name", name), [(name, "1")], note=name).markdown()
    page = markdown.markdown(text, extensions=["tables"])
    tags = {tag.lower() for tag in re.findall(r"</?(\w+)", page)}
    assert tags <= {"h2", "table", "thead", "tbody", "tr", "th", "td", "p"}
    shown = " ".join(name.split("\n"))
    assert unescape(re.sub(r"<[^<>]*>", "\n", page)).split("\n").count(shown) == 4


def _per_class(count: int) -> Table:
    """Table of classes with intervals; class k has the share k * 7 % count."""
    names = [f"class_with_a_long_name_{k}" for k in range(count)]
    result = example_result([0.5] * count, names, bands=[0.5])
    classes = [{**one, "share": 7 * k % count / count} for k, one in enumerate(result.classes)]
    intervals = dict.fromkeys(result.scores, (0.456, 0.545))
    counts = [[1] * (count + 1)] * (count + 1)
    changes = {"classes": classes, "intervals": intervals, "confusion": counts}
    return result_tables(replace(result, **changes))[0]  # type: ignore[arg-type]


@pytest.mark.parametrize("count", [20, 150])
def test_printed_classes_fit_100_columns_the_largest_first(
    count: int, capsys: pytest.CaptureFixture[str]
) -> None:
    table = _per_class(count)
    table.print()
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= 100
    text = "".join(lines)
    shown = [int(k) for k in re.findall(r"long_name_(\d+)", text)]
    if count <= 20:
        assert shown == [*range(count)]
        assert "more in" not in text
    else:
        assert shown == sorted(range(count), key=lambda k: -(7 * k % count))[:20]
        assert f"… {count - 20} more in results.json" in text
    assert "[45.6, 54.5]" in text  # of the mean
    assert table.markdown().count("long_name_") == count


def test_a_note_names_the_first_absent_classes() -> None:
    names = [f"class_{k}" for k in range(150)]
    result = example_result([0.5, *[None] * 149], names)
    table = result_tables(replace(result, confusion=[[0] * 151] * 151))[0]
    assert table.note.endswith(": " + ", ".join(names[1:26]) + ", … 124 more.")
