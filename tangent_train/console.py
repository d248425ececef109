"""Print the messages of commands."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rich.console import Console

from tangent_train.errors import printable

_LOG = logging.getLogger("tangent_train.printed")
_LOG.propagate = False  # to log files only: Hydra prints what reaches its loggers


@contextmanager
def log_to(file: Path) -> Iterator[None]:
    """Append printed texts and tables, warnings and an error in a block to a file."""
    handler, shown = logging.FileHandler(file, encoding="utf-8", delay=True), warnings.showwarning
    handler.setFormatter(logging.Formatter("%(asctime)s %(message)s", "%Y-%m-%d %H:%M:%S"))
    loggers = [_LOG, logging.getLogger("lightning.pytorch")]

    def show(*warning: Any, **named: Any) -> None:
        _LOG.info("%s: %s", warning[1].__name__, warning[0])
        shown(*warning, **named)

    _LOG.setLevel(logging.INFO)
    for logger in loggers:
        logger.addHandler(handler)
    warnings.showwarning = show
    try:
        yield
    except Exception as error:
        _LOG.info("%s: %s", type(error).__name__, error)
        raise
    finally:
        warnings.showwarning = shown
        for logger in loggers:
            logger.removeHandler(handler)
        handler.close()


def log_text(text: str) -> None:
    """Write text to the log file, see `log_to`."""
    _LOG.info(text)


def print_text(text: str, *, error: bool = False) -> None:
    """Print text without markup, highlights, and breaks at the width of the terminal.

    Control characters are escaped: names of files and classes are untrusted.

    Args:
        text: Lines to print.
        error: True to print to standard error.
    """
    _LOG.info(printable(text))
    Console(stderr=error, soft_wrap=True, highlight=False).print(printable(text), markup=False)
