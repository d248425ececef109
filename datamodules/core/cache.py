"""Cache: decoded data, memory-mapped by every sample.

A cache is a folder of ``.npy`` files, one for each panorama, photo or shape. A file holds one
record whose fields are the arrays (``numpy.load`` reads it). Its folder has the settings of the
decoding in its name, and the file the sizes and times of its source files: a change of either makes
another file. Rendering a view reads only the pages it needs, shared by all processes.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from tangent_train.files import atomic_path


class Cache:
    """A folder of decoded items, for the settings of a decoding.

    Args:
        folder: Folder of the caches for all settings, created on the first write.
        settings: Everything that the arrays depend on besides the source files.
        kind: Named tuple of the arrays of an item; missing arrays are None.
    """

    def __init__(self, folder: Path, settings: Mapping[str, Any], kind: type[Any]) -> None:
        self.folder = folder / _digest(sorted(settings.items()))
        self.kind = kind

    def read(self, files: Any, decode: Callable[[], Any]) -> Any:
        """Return an item, as read-only views of its file, which is written first if missing.

        Args:
            files: Source files of the item, with their `name` and `paths`.
            decode: Function that decodes them.

        Raises:
            DataError: A source file is broken.
            OSError: The disk is full.
        """
        path = self.path(files)
        if not path.is_file():
            arrays = {name: a for name, a in decode()._asdict().items() if a is not None}
            record = np.empty((), [(name, a.dtype, a.shape) for name, a in arrays.items()])
            for name, array in arrays.items():
                record[name] = array
            with atomic_path(path) as temporary:
                np.save(temporary, record, allow_pickle=False)
        record = np.load(path, mmap_mode="r", allow_pickle=False)
        missing = dict.fromkeys(self.kind._fields)
        return self.kind(
            **missing | {name: np.asarray(record[name]) for name in record.dtype.names}
        )

    def path(self, files: Any) -> Path:
        """Return the file of an item, in the present version of its source files."""
        stats = [(path.name, path.stat()) for path in files.paths]
        version = _digest([(name, stat.st_size, stat.st_mtime_ns) for name, stat in stats])
        return self.folder / f"{files.name}.{version}.npy"


def _digest(values: Any) -> str:
    return hashlib.sha256(repr(values).encode()).hexdigest()[:10]
