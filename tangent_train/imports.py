"""Imports and calls of other libraries: without local files, downloads and output."""

from __future__ import annotations

import io
import logging
import multiprocessing  # noqa: F401 - notes the working directory, where its processes start
import os
import sys
import warnings
from collections.abc import Iterator
from contextlib import chdir, contextmanager, redirect_stderr, redirect_stdout
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any


def import_own_packages() -> None:
    """Import our ``models`` and ``datamodules``, whatever else on the path is called so.

    Raises:
        ImportError: Another module of this name is imported already.
    """
    root = str(Path(__file__).parents[1])
    for name in ("datamodules", "models"):
        other = None if name in sys.modules else find_spec(name)
        sys.path.insert(0, root)
        own = import_module(name)
        sys.path.remove(root)
        if own.__file__ != str(Path(root, name, "__init__.py")):
            raise ImportError(
                f"{own.__file__} is imported, but tangent-train has a package of this name. "
                "Import tangent_train first, or rename the other one."
            )
        if other is not None and other.origin != own.__file__:
            sys.stderr.write(
                f"{other.origin} is not used: tangent-train has a package of this name. Rename its "
                "folder to use what is in it in a config.\n"
            )


@contextmanager
def elsewhere() -> Iterator[None]:
    """A block with imports, for which the working directory is that of this package.

    Torch loads ``libcuda.so.1``, numba reads ``.numba_config.yaml`` and matplotlib ``matplotlibrc``
    from the working directory while they are imported. A folder of other people's files may hold
    any of these. OpenCV adds an empty entry to ``LD_LIBRARY_PATH``, with which further processes
    would look for all their libraries there.
    """
    with chdir(Path(__file__).parent):
        try:
            yield
        finally:
            entries = os.environ.pop("LD_LIBRARY_PATH", "").split(os.pathsep)
            if entries := [entry for entry in entries if entry]:
                os.environ["LD_LIBRARY_PATH"] = os.pathsep.join(entries)


@contextmanager
def offline() -> Iterator[None]:
    """Keep huggingface_hub, and all libraries that fetch through it, off the network in a block.

    What the block would fetch is an error of these libraries, unless it is in their local cache.
    """
    try:
        from huggingface_hub import constants
    except ImportError:  # nor is any library that fetches through it
        yield
        return
    hub: Any = constants
    before = hub.HF_HUB_OFFLINE
    hub.HF_HUB_OFFLINE = True  # the value of the environment variable, which is read at import
    try:
        yield
    finally:
        hub.HF_HUB_OFFLINE = before


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


def is_private(folder: Path) -> bool:
    """True if a folder belongs to this user, and other users have no access to it.

    Args:
        folder: Existing folder. Windows keeps other users out of the folders of a user.
    """
    found = folder.stat()
    return os.name == "nt" or (found.st_uid == os.geteuid() and not found.st_mode & 0o077)
