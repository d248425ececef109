"""Import and call other libraries without local files, downloads and output."""

from __future__ import annotations

import io
import logging
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any


def import_own_packages() -> None:
    """Import ``models`` and ``datamodules`` of this package, not modules with these names.

    Raises:
        ImportError: Another module with such a name has been imported.
    """
    root = str(Path(__file__).parents[1])
    for name in ("datamodules", "models"):
        other = None if name in sys.modules else find_spec(name)
        sys.path.insert(0, root)
        package = import_module(name)
        sys.path.remove(root)
        if package.__file__ != str(Path(root, name, "__init__.py")):
            raise ImportError(
                f"{package.__file__} is imported, but tangent-train has a package of this name. "
                "Import tangent_train first, or rename the other one."
            )
        if other is not None and other.origin != package.__file__:
            sys.stderr.write(
                f"{other.origin} is not used: tangent-train has a package of this name. Rename it "
                "to use its classes in a config.\n"
            )


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
    hub: Any = constants
    before = hub.HF_HUB_OFFLINE
    hub.HF_HUB_OFFLINE = True  # the environment variable is read only at import
    try:
        yield
    finally:
        hub.HF_HUB_OFFLINE = before


@contextmanager
def hide_output() -> Iterator[None]:
    """Hide log records, warnings and printed lines in a block whose results are verified."""
    disabled = logging.root.manager.disable
    logging.disable()
    try:
        silent = io.StringIO()
        with warnings.catch_warnings(), redirect_stdout(silent), redirect_stderr(silent):
            warnings.simplefilter("ignore")
            yield
    finally:
        logging.disable(disabled)
