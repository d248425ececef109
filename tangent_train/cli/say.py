"""What commands print."""

from __future__ import annotations

from rich.console import Console


def say(text: str, *, error: bool = False) -> None:
    """Print text as it is: without markup, highlights, and breaks at the width of the terminal.

    Args:
        text: Lines.
        error: Print to standard error.
    """
    Console(stderr=error, soft_wrap=True, highlight=False).print(text, markup=False)
