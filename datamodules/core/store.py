"""Prepared store: data decoded once, then memory-mapped by every sample.

A store is a folder of ``.npy`` files, one for each panorama, photo or shape. A file holds one
record whose fields are the arrays (``numpy.load`` reads it), followed by one line of JSON: name,
size and time of the source files, and a checksum of everything before. It is out of date when the
source files change.

Memory-mapped: rendering a tangent image reads only the pages it needs, shared by all processes.
docs/how-to/prepared_store.md compares this with other formats.
"""

from __future__ import annotations

import hashlib
import json
import zlib
from collections.abc import Callable, Container, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tangent_train.errors import DataError
from tangent_train.files import atomic_path

_REMEDY = (
    "Run tangent-prepare with the same settings (data.store=… and all of data and representation): "
    "it makes what is missing, broken or out of date, and nothing else."
)


class Declared(NamedTuple):
    """An array of every item of a store.

    Attributes:
        dtype: Name of the type.
        shape: Sides; a named side has the same length in all arrays of an item.
        most: Largest allowed value; None for no limit.
    """

    dtype: str
    shape: tuple[int | str, ...]
    most: int | None = None

    def __str__(self) -> str:
        """Format for messages."""
        most = "" if self.most is None else f" up to {self.most}"
        return f"{self.dtype} ({', '.join(map(str, self.shape))}){most}"

    def allows(self, array: NDArray[Any], lengths: dict[int | str, int], *, values: bool) -> bool:
        """Return True if an array of an item is as declared.

        Args:
            array: The array.
            lengths: Lengths of named sides so far; those of the array are added.
            values: True to check the largest value too.
        """
        if array.dtype != self.dtype or array.ndim != len(self.shape):
            return False
        sides = zip(self.shape, array.shape, strict=True)
        fits = all(lengths.setdefault(s, n if isinstance(s, str) else s) == n for s, n in sides)
        return fits and not (values and self.most is not None and array.max(initial=0) > self.most)


Layout = Mapping[str, Declared]
"""Declared arrays by name; only ``depth`` is optional."""


class Store:
    """A folder of prepared arrays.

    Args:
        folder: Folder, created on the first write.
        layout: Declared arrays of an item.
    """

    def __init__(self, folder: Path, layout: Layout) -> None:
        self.folder = folder
        self._layout = layout
        self._whole: set[str] = set()

    @classmethod
    def of(
        cls, folder: Path | None, name: str, settings: Mapping[str, str], layout: Layout
    ) -> Store | None:
        """Return the store for some settings, in a separate subfolder.

        Args:
            folder: Folder of the stores for all settings; None for no store.
            name: Prefix of the subfolder's name.
            settings: Settings that affect the arrays besides the files.
            layout: Declared arrays of an item.
        """
        if folder is None:
            return None
        digest = hashlib.sha256(repr(sorted(settings.items())).encode()).hexdigest()
        return cls(folder / f"{name}_{digest[:8]}", layout)

    def path(self, name: str) -> Path:
        """Return the file of one item."""
        return self.folder / f"{name}.npy"

    def make(
        self, name: str, files: Mapping[str, Path], read: Callable[[], Mapping[str, NDArray[Any]]]
    ) -> None:
        """Write the file of one item atomically.

        Args:
            name: Name of the item, with ``/`` between folders.
            files: Source files of the item, by part.
            read: Function that decodes the files to named arrays.

        Raises:
            DataError: A file is broken.
            OSError: The disk is full.
        """
        # Taken before the files are read, so that a change meanwhile is noticed later.
        made_from = _stamps(files)
        arrays = read()
        record = np.empty((), [(key, a.dtype, a.shape) for key, a in arrays.items()])
        for key, array in arrays.items():
            record[key] = array
        with atomic_path(self.path(name)) as temporary:
            np.save(temporary, record, allow_pickle=False)
            content = {"made_from": made_from, "crc32": _checksum(temporary)}
            with temporary.open("ab") as file:
                file.write(b"\n" + json.dumps(content).encode())

    def read(
        self, name: str, files: Mapping[str, Path], *, whole: bool = True
    ) -> dict[str, NDArray[Any]]:
        """Return the arrays of one item, as read-only views of its file.

        Types, shapes and source files are checked every time; the checksum and the largest values
        only the first time.

        Args:
            name: Name of the item.
            files: Required source files; the stored item may have more.
            whole: True to check the content too.

        Raises:
            DataError: The file is missing, damaged, out of date, or differs from the declaration.
        """
        path = self.path(name)
        try:
            record: Any = np.load(path, mmap_mode="r", allow_pickle=False)
            size = record.offset + record.nbytes
            with path.open("rb") as file:
                file.seek(size)
                content = json.loads(file.read())
            checked = not whole or name in self._whole
            total = None if checked else _checksum(path, size)
            arrays = {key: np.asarray(record[key]) for key in record.dtype.names}
            written, found = content["crc32"], dict.fromkeys(files, "nothing")
            found |= content["made_from"]
        except FileNotFoundError as error:
            raise _unusable(path, "no such file", "a file of the prepared store") from error
        except Exception as error:  # NumPy raises many kinds of errors for damaged files
            what = f"a damaged file ({type(error).__name__}: {error})"
            raise _unusable(path, what, "a whole one") from error
        if total not in (None, written):
            raise _unusable(path, "a damaged file (another checksum)", "a whole one")
        for part, stamp in _stamps(files).items():
            if found[part] != stamp:
                raise _unusable(path, f"{part} made from {found[part]}", stamp)
        self._check_layout(path, arrays, files, values=not checked)
        self._whole |= {name} if whole else set()
        return arrays

    def _check_layout(
        self, path: Path, arrays: Mapping[str, NDArray[Any]], files: Container[str], *, values: bool
    ) -> None:
        """Refuse arrays that differ from the declaration."""
        required = {key for key in self._layout if key != "depth" or key in files}
        lengths: dict[int | str, int] = {}
        if required <= arrays.keys() <= self._layout.keys() and all(
            self._layout[key].allows(array, lengths, values=values) for key, array in arrays.items()
        ):
            return
        found = (f"{key}: {array.dtype} {array.shape}" for key, array in arrays.items())
        expected = (f"{key}: {declared}" for key, declared in self._layout.items())
        raise _unusable(path, ", ".join(found), ", ".join(expected))

    def is_current(self, name: str, files: Mapping[str, Path], *, whole: bool) -> bool:
        """Return True if `read` accepts the file of an item."""
        try:
            self.read(name, files, whole=whole)
        except (DataError, OSError):
            return False
        return True


def _checksum(path: Path, size: int | None = None) -> int:
    """Return the CRC-32 of the first bytes of a file, or of all bytes."""
    content: Any = np.memmap(path, mode="r", shape=size)
    return zlib.crc32(content)


def _stamps(files: Mapping[str, Path]) -> dict[str, str]:
    """Return size and time of each file, which identify its version."""
    stamps = {}
    for part, path in files.items():
        status = path.stat()
        stamps[part] = f"{path.name} ({status.st_size} bytes of {status.st_mtime_ns} ns)"
    return stamps


def _unusable(path: Path, found: str, expected: str) -> DataError:
    return DataError(path, found=found, expected=expected, remedy=_REMEDY)
