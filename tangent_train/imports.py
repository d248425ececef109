"""Importing libraries that search the working directory for their own files."""

from __future__ import annotations

import multiprocessing  # noqa: F401 - notes the working directory, where its processes start
import os
from collections.abc import Iterator
from contextlib import chdir, contextmanager
from pathlib import Path


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


def is_private(folder: Path) -> bool:
    """True if a folder belongs to this user, and other users have no access to it.

    Args:
        folder: Existing folder. Windows keeps other users out of the folders of a user.
    """
    found = folder.stat()
    return os.name == "nt" or (found.st_uid == os.geteuid() and not found.st_mode & 0o077)
