"""Output of other libraries that is for their developers."""

from __future__ import annotations

import io
import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout


@contextmanager
def hide_output() -> Iterator[None]:
    """Hide log records, warnings and printed lines of a library whose results are verified."""
    disabled = logging.root.manager.disable
    logging.disable()
    try:
        silent = io.StringIO()
        with warnings.catch_warnings(), redirect_stdout(silent), redirect_stderr(silent):
            warnings.simplefilter("ignore")
            yield
    finally:
        logging.disable(disabled)
