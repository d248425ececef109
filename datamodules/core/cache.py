"""Cache: decoded data, memory-mapped by every sample.

A cache is a folder of ``.npy`` files, one for each panorama, photo or shape. A file holds one
record whose fields are the arrays (``numpy.load`` reads it). Its folder has the settings of the
decoding in its name, and the file the sizes and times of its source files: a change of either makes
another file. Rendering a view reads only the pages it needs, shared by all processes.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, TypeVar

import numpy as np

from tangent_train.files import atomic_path

_Item = TypeVar("_Item", bound=tuple[Any, ...])


class Files(Protocol):
    """The source files of one image or shape."""

    @property
    def name(self) -> str:
        """Unique short name; ``/`` between groups."""
        ...

    @property
    def paths(self) -> Iterable[Path]:
        """All source files."""
        ...


@dataclass(frozen=True)
class Cache:
    """A folder of decoded items.

    Attributes:
        folder: Folder, created on the first write.
        kind: Named tuple of the arrays of an item; missing arrays are None.
    """

    folder: Path
    kind: type[Any]

    @classmethod
    def of(cls, folder: Path, settings: Mapping[str, Any], kind: type[Any]) -> Cache:
        """Return the cache for the settings of a decoding, in a subfolder.

        Args:
            folder: Folder of the caches for all settings.
            settings: Everything that the arrays depend on besides the source files.
            kind: Named tuple of the arrays.
        """
        return cls(folder / _digest(sorted(settings.items())), kind)

    def read(self, files: Files, decode: Callable[[], _Item]) -> _Item:
        """Return an item, as read-only views of its file, which is written first if missing.

        Args:
            files: Source files of the item.
            decode: Function that decodes them.

        Raises:
            DataError: A source file is broken.
            OSError: The disk is full.
        """
        path = self.path(files)
        if not path.is_file():
            self._write(path, decode())
        record = np.load(path, mmap_mode="r", allow_pickle=False)
        arrays = {name: np.asarray(record[name]) for name in record.dtype.names}
        item: _Item = self.kind(**{**dict.fromkeys(self.kind._fields), **arrays})
        return item

    def path(self, files: Files) -> Path:
        """Return the file of an item, in the present version of its source files."""
        stats = [(path.name, path.stat()) for path in files.paths]
        version = _digest([(name, stat.st_size, stat.st_mtime_ns) for name, stat in stats])
        return self.folder / f"{files.name}.{version}.npy"

    @staticmethod
    def _write(path: Path, item: Any) -> None:
        arrays = {name: a for name, a in item._asdict().items() if a is not None}
        record = np.empty((), [(name, a.dtype, a.shape) for name, a in arrays.items()])
        for name, array in arrays.items():
            record[name] = array
        with atomic_path(path) as temporary:
            np.save(temporary, record, allow_pickle=False)


def _digest(values: Any) -> str:
    return hashlib.sha256(repr(values).encode()).hexdigest()[:10]
