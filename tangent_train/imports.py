"""Import and call other libraries without local files, downloads and output."""

from __future__ import annotations

import io
import logging
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any
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


def on_first_use(package: str, homes: Mapping[str, str]) -> Callable[[str], Any]:
    """Return the ``__getattr__`` of a package whose names are imported when they are first used.

    Importing a small module of the package then does not import all its libraries.

    Args:
        package: Name of the package.
        homes: Module in the package by the name that it defines.
    """

    def imported(name: str) -> Any:
        if name not in homes:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return getattr(import_module(f"{package}.{homes[name]}"), name)

    return imported


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
