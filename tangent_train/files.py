"""Files: written atomically; those of torch, JSON and CSV."""

from __future__ import annotations

import csv
import errno
import io
import json
import os
import re
import shutil
import tempfile
import zlib
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import reduce
from pathlib import Path
from typing import IO, Any
from zipfile import ZipFile, is_zipfile

from tangent_train.errors import DataError, SettingError
from tangent_train.imports import elsewhere

_PREFIX = ".partial-"
_FULL = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}
_PROBE = bytes(1 << 16)


class NoRoomError(SettingError):
    """A full disk, an exhausted quota, or a file above the size limit."""


def no_room(path: Path, error: BaseException) -> NoRoomError | None:
    """Error with a remedy if a file did not fit on the disk.

    Args:
        path: The file.
        error: The raised error.

    Returns:
        None if it was raised for another reason.
    """
    if not isinstance(error, OSError) or error.errno not in _FULL:
        return None
    folder = next((parent for parent in path.absolute().parents if parent.exists()), Path("/"))
    return NoRoomError(
        path,
        found=f"{os.strerror(error.errno).lower()} ({shutil.disk_usage(folder).free / 1e9:.1f} GB "
        "free)",
        expected="room for the file",
        remedy="Existing files are unchanged. Free some space, or write to another disk.",
    )


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside `path` that replaces it when the block succeeds.

    The new file is on the disk before it takes the place of the old one, so that a power cut leaves
    one of the two. A process that is killed leaves the temporary file behind, ``.partial-…``.

    Args:
        path: The file to write; its folder is created. An existing file stays untouched until the
            replacement is complete, and for good if the block raises.

    Yields:
        A path in the same folder with the same suffix, to be written by the block.

    Raises:
        NoRoomError: The disk is full.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(dir=path.parent, prefix=_PREFIX, suffix=path.suffix)
    except OSError as error:
        raise no_room(path, error) or OSError(error.errno, error.strerror, str(path)) from error
    os.close(handle)
    temporary = Path(name)
    try:
        temporary.chmod(0o644)
        yield temporary
        _sync(temporary)
        temporary.replace(path)
        _sync(path.parent)
    except Exception as error:
        known = isinstance(error, OSError) and error.errno is not None
        full = no_room(path, error if known else _refused(temporary))
        if full is None:
            raise
        raise full from error
    finally:
        temporary.unlink(missing_ok=True)


def reserve(file: IO[bytes], size: int) -> None:
    """Allocate the disk space of a file before it is written through memory mapping.

    A mapped file is sparse at first; a full disk then kills the process. macOS and Windows cannot
    allocate in advance.

    Args:
        file: Open for reading and writing.
        size: Final size of the file in bytes.

    Raises:
        OSError: There is too little room.
    """
    if hasattr(os, "posix_fallocate"):
        os.posix_fallocate(file.fileno(), 0, size)


def _sync(path: Path) -> None:
    """Flush a file, or the names in a folder, to the disk."""
    if path.is_dir() and os.name == "nt":  # where folders cannot be opened
        return
    handle = os.open(path, os.O_RDONLY if path.is_dir() else os.O_RDWR)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def write_bytes(path: Path, content: bytes) -> None:
    """Write `content` to `path` atomically."""
    with atomic_path(path) as temporary:
        temporary.write_bytes(content)


def write_text(path: Path, content: str) -> None:
    """Write `content` to `path` atomically, UTF-8."""
    # Names of files may contain bytes that are not text.
    write_bytes(path, content.encode(errors="backslashreplace"))


def _refused(path: Path) -> OSError:
    """The reason why a file cannot grow, which libraries do not report."""
    try:
        with path.open("ab") as file:
            file.write(_PROBE)
            file.flush()
    except OSError as error:
        return error
    return OSError()


def load_plain(path: Path, expected: str, *, mmap: bool = False, whole: bool = True) -> Any:
    """Load a file of `torch.save` that holds tensors and plain values; nothing else is unpickled.

    Args:
        path: The file.
        expected: For the message.
        mmap: Map the tensors into memory instead of reading them.
        whole: Compare everything in the file with its checksums, which torch does not; this reads
            all of it. Files of torch before version 1.6 have none.

    Raises:
        DataError: It is missing, damaged, or holds other objects.
    """
    if not path.exists():
        raise DataError(path, found="no such file", expected=expected)
    with elsewhere():
        import torch

    try:
        content = torch.load(path, map_location="cpu", weights_only=True, mmap=mmap)
        damaged = None
        if whole and is_zipfile(path):
            with ZipFile(path) as archive:
                damaged = archive.testzip()
    except Exception as error:
        if named := re.search(r"GLOBAL (\S+)", str(error)):
            found = f"{named[1]}, a class"
            remedy = "Save its state_dict() alone: reading objects can run anything."
        else:
            found = "a damaged file, or none of torch.save"
            remedy = ""
        raise DataError(path, found=found, expected=expected, remedy=remedy) from error
    check_sum(path, damaged is None)
    return content


def check_sum(path: Path, same: bool) -> None:
    """Refuse a file whose content is another one than when it was written.

    Args:
        path: The file.
        same: True if its checksum is right.

    Raises:
        DataError: It is not.
    """
    if not same:
        raise DataError(
            path,
            found="a damaged file, whose checksum is wrong",
            expected="the file as it was written",
            remedy="Copy it again from where it was written.",
        )


def crc32_of(parts: Iterable[bytes | memoryview]) -> str:
    """CRC-32 of bytes, one after the other, as eight hexadecimal digits."""
    return f"{reduce(lambda crc, part: zlib.crc32(part, crc), parts, 0):08x}"


def parse_json(text: str | bytes) -> Any:
    """`json.loads`, with a `ValueError` for text that is nested too deeply or names a value twice.

    Args:
        text: UTF-8, UTF-16 or UTF-32 where it is bytes.

    Raises:
        ValueError: The text is not JSON.
    """
    try:
        return json.loads(text, object_pairs_hook=_unique)
    except RecursionError as error:
        raise ValueError("its brackets are nested too deeply") from error


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """A mapping that has every name once: readers differ in which of two values they take."""
    content = dict(pairs)
    if len(content) < len(pairs):
        ((name, _),) = Counter(name for name, _ in pairs).most_common(1)
        raise ValueError(f"{name!r} is there twice")
    return content


def read_json(path: Path, expected: str, remedy: str = "") -> Any:
    """The content of a JSON file.

    Args:
        path: The file.
        expected: For the message.
        remedy: For the message.

    Raises:
        DataError: It cannot be read, or is no JSON.
    """
    try:
        return parse_json(path.read_bytes())
    except (OSError, ValueError) as error:
        raise DataError(path, found=error, expected=expected, remedy=remedy) from error


_FORMULA = ("=", "+", "-", "@", "\t", "\r")
"""First characters of text that spreadsheets evaluate (OWASP, "CSV Injection")."""


def csv_text(columns: Sequence[str], rows: Iterable[Mapping[str, Any] | Sequence[Any]]) -> str:
    r"""A table as CSV, its header first.

    Text that a spreadsheet would take for a formula is prefixed with ``'``: names of classes and
    files are untrusted.

    Args:
        columns: Names of the columns.
        rows: Values in that order, or by column; None, or a missing one, is an empty cell.

    >>> csv_text(["class", "iou"], [{"class": "=1+1", "iou": -0.5}])
    "class,iou\n'=1+1,-0.5\n"
    """
    file = io.StringIO()
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(map(_cell, columns))
    for row in rows:
        cells = [row.get(name) for name in columns] if isinstance(row, Mapping) else row
        writer.writerow(map(_cell, cells))
    return file.getvalue()


def _cell(value: Any) -> Any:
    return f"'{value}" if isinstance(value, str) and value.startswith(_FORMULA) else value
