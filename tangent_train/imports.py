"""Import and call other libraries without local files, downloads and output."""

from __future__ import annotations

import io
import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from importlib.util import find_spec
from pathlib import Path
from unittest.mock import patch


def check_own_packages() -> None:
    """Refuse other modules named ``models`` or ``datamodules`` in place of those of this package.

    Raises:
        ImportError: Such a module comes first on the path.
    """
    root = Path(__file__).parents[1]
    for name in ("datamodules", "models"):
        spec = find_spec(name)
        found = None if spec is None else spec.origin
        if found is None or Path(found).parents[1] != root:
            raise ImportError(f"{found} has the name of a package of tangent-train: rename it")


@contextmanager
def offline() -> Iterator[None]:
    """Keep huggingface_hub, and libraries that download with it, off the network in a block.

    A download is an error of these libraries, unless the file is in their local cache.
    """
    try:
        from huggingface_hub import constants
    except ImportError:  # no library downloads with it either
        yield
        return
    with patch.object(constants, "HF_HUB_OFFLINE", new=True):  # its variable is read at import
        yield


@contextmanager
def hide_output() -> Iterator[None]:
    """Hide log records, warnings and printed lines in a block whose results are verified."""
    disabled, silent = logging.root.manager.disable, io.StringIO()
    logging.disable()
    try:
        with warnings.catch_warnings(), redirect_stdout(silent), redirect_stderr(silent):
            warnings.simplefilter("ignore")
            yield
    finally:
        logging.disable(disabled)
