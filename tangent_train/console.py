"""Print the messages of commands."""

from __future__ import annotations

from rich.console import Console

from tangent_train.errors import printable


def print_text(text: str, *, error: bool = False) -> None:
    """Print text without markup, highlights, and breaks at the width of the terminal.

    Control characters are escaped: names of files and classes are untrusted.

    Args:
        text: Lines to print.
        error: True to print to standard error.
    """
    Console(stderr=error, soft_wrap=True, highlight=False).print(printable(text), markup=False)
