"""Tables show names of runs, classes and files as text, whatever they contain."""

from __future__ import annotations

import re
from html import unescape

import markdown  # type: ignore[import-untyped]
import pytest

from tangent_train.results.tables import Table


@pytest.mark.parametrize(
    "name",
    [
        "<script>alert(1)</script>",
        "<img src=x onerror=alert(1)>",
        "[run](javascript:alert(1))",
        "![run](http://x/y.png)",
        r"[run\](javascript:alert(1))",
        r"[run]\(javascript:alert(1))",
        "[run][1] and [1]: javascript:alert(1)",
        "<javascript:alert(1)>",
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
