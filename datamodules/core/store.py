"""The prepared store: data decoded once and then memory-mapped by every sample.

A store is a folder of ``.npy`` files, one for each panorama, photo or shape. A file holds one
record whose fields are the arrays (``numpy.load`` reads it), followed by one line of JSON: name,
size and time of the files it was made from. It counts as out of date when these change.

Memory-mapped: rendering a tangent image touches only the pages it needs, shared by all processes.
docs/store.md compares this with other formats.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tangent_train.errors import DataError
from tangent_train.files import atomic_path, parse_json

_REMEDY = (
    "Run tangent-prepare with the same settings (data.store=… and all of data and representation): "
    "it makes what is missing, broken or out of date, and nothing else."
)


class Store:
    """A folder of prepared arrays.

    Args:
        folder: The folder; created on the first write.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    @classmethod
    def of(cls, folder: Path | None, name: str, settings: Mapping[str, str]) -> Store | None:
        """Store of one choice of settings, in its own subfolder.

        Args:
            folder: Of the stores of all choices; without it, there is no store.
            name: Prefix of the subfolder's name.
            settings: Settings that affect the arrays besides the files.
        """
        if folder is None:
            return None
        digest = hashlib.sha256(repr(sorted(settings.items())).encode()).hexdigest()
        return cls(folder / f"{name}_{digest[:8]}")

    def path(self, name: str) -> Path:
        """The file of one item."""
        return self.folder / f"{name}.npy"

    def make(
        self, name: str, files: Mapping[str, Path], read: Callable[[], Mapping[str, NDArray[Any]]]
    ) -> None:
        """Write the file of one item atomically.

        Args:
            name: Of the item, with ``/`` between folders.
            files: Its source files, by part.
            read: Decodes them to named arrays.

        Raises:
            DataError: A file is broken.
            NoRoomError: The disk is full.
        """
        # Asked before the files are read: a change meanwhile is noticed later.
        made_from = _stamps(files)
        arrays = read()
        record = np.empty((), [(key, a.dtype, a.shape) for key, a in arrays.items()])
        for key, array in arrays.items():
            record[key] = array
        with atomic_path(self.path(name)) as temporary, temporary.open("wb") as file:
            np.save(file, record, allow_pickle=False)
            file.write(b"\n" + json.dumps(made_from).encode())

    def read(self, name: str, files: Mapping[str, Path]) -> dict[str, NDArray[Any]]:
        """The arrays of one item, read-only views of its file.

        Args:
            name: Of the item.
            files: Required source files; it may have more.

        Raises:
            DataError: It is missing, truncated or out of date.
        """
        path = self.path(name)
        try:
            record: Any = np.load(path, mmap_mode="r", allow_pickle=False)
            with path.open("rb") as file:
                file.seek(record.offset + record.nbytes)
                made_from = dict(parse_json(file.read()))
            arrays = {key: np.asarray(record[key]) for key in record.dtype.names}
            found = {part: made_from.get(part, "nothing") for part in files}
        except FileNotFoundError as error:
            raise _unusable(path, "no such file", "a file of the prepared store") from error
        except Exception as error:  # NumPy has many ways to say that a file is damaged
            what = f"a damaged file ({type(error).__name__}: {error})"
            raise _unusable(path, what, "a whole one") from error
        for part, stamp in _stamps(files).items():
            if found[part] != stamp:
                raise _unusable(path, f"{part} made from {found[part]}", stamp)
        return arrays

    def is_current(self, name: str, files: Mapping[str, Path]) -> bool:
        """Whether the file of one item is there, whole and up to date."""
        try:
            self.read(name, files)
        except (DataError, OSError):
            return False
        return True


def _stamps(files: Mapping[str, Path]) -> dict[str, str]:
    """Size and time of every file, which identify its version."""
    stamps = {}
    for part, path in files.items():
        status = path.stat()
        stamps[part] = f"{path.name} ({status.st_size} bytes of {status.st_mtime_ns} ns)"
    return stamps


def _unusable(path: Path, found: str, expected: str) -> DataError:
    return DataError(path, found=found, expected=expected, remedy=_REMEDY)
