"""Write files atomically; read and write files of torch, JSON and CSV."""

from __future__ import annotations

import argparse
import csv
import datetime
import errno
import io
import json
import os
import re
import stat
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import IO, Any

from pydantic import TypeAdapter, ValidationError

from tangent_train.errors import DataError, SettingError, check_choice, wrong_field


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """Yield a temporary path in the folder of `path`, which replaces it when the block succeeds.

    The new file is flushed to disk before it replaces the old one, so that a power cut leaves one
    of the two. A process that is killed leaves the temporary file ``.partial-…``.

    Args:
        path: File to write; its folder is created. An existing file is unchanged until it is
            replaced, and if the block raises an error.

    Yields:
        Path in the same folder with the same suffix, to be written by the block.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=".partial-", suffix=path.suffix)
    os.close(handle)
    temporary = Path(name)
    try:
        temporary.chmod(0o644)
        yield temporary
        _sync(temporary)
        temporary.replace(path)
        _sync(path.parent)
    finally:
        temporary.unlink(missing_ok=True)


def checked_file(path: Path) -> Path:
    """Return the path of a file; a pipe or device would be waited for.

    Raises:
        OSError: It is missing, a link to itself, or neither a file nor a folder.
    """
    if stat.S_IFMT(path.stat().st_mode) not in (stat.S_IFREG, stat.S_IFDIR):
        raise OSError(errno.EINVAL, "a pipe, socket or device", str(path))
    return path


def reserve(file: IO[bytes], size: int) -> None:
    """Allocate the disk space of a file before it is written through memory mapping.

    A mapped file is sparse at first; a full disk then kills the process. macOS and Windows cannot
    allocate in advance.

    Args:
        file: File, open for reading and writing.
        size: Final size of the file in bytes.

    Raises:
        OSError: There is not enough room.
    """
    if hasattr(os, "posix_fallocate"):
        os.posix_fallocate(file.fileno(), 0, size)


def _sync(path: Path) -> None:
    """Flush a file, or the names in a folder, to the disk."""
    if path.is_dir() and os.name == "nt":  # folders cannot be opened there
        return
    handle = os.open(path, os.O_RDONLY if path.is_dir() else os.O_RDWR)
    os.fsync(handle)
    os.close(handle)


def write_bytes(path: Path, content: bytes) -> None:
    """Write `content` to `path` atomically."""
    with atomic_path(path) as temporary:
        temporary.write_bytes(content)


def write_text(path: Path, content: str) -> None:
    """Write `content` to `path` atomically, as UTF-8."""
    # Names of files may contain bytes that are not UTF-8.
    write_bytes(path, content.encode(errors="backslashreplace"))


def load_plain(path: Path, expected: str, *, mmap: bool = False) -> Any:
    """Load tensors and plain values from a file of `torch.save`; nothing else is unpickled.

    Args:
        path: File to load.
        expected: Expected file, for the message.
        mmap: True to map the tensors into memory instead of reading them.

    Raises:
        DataError: The file is missing, damaged, or contains other objects.
    """
    import torch

    try:
        with torch.serialization.safe_globals(_plain_classes()):
            return torch.load(checked_file(path), map_location="cpu", weights_only=True, mmap=mmap)
    except Exception as error:
        is_read = not isinstance(error, OSError)
        found, remedy = "a damaged file, or not a file of torch.save" if is_read else error, ""
        if named := re.search(r"GLOBAL (\S+)", str(error)):
            found = f"{named[1]}, a class"
            remedy = "Save only its state_dict(): reading objects can run arbitrary code."
        raise DataError(path, found=found, expected=expected, remedy=remedy) from error


def _plain_classes() -> list[Any]:
    """Return classes of plain values, which run nothing, with the names of other versions."""
    import numpy as np
    from numpy._core.multiarray import scalar

    values: list[Any] = [argparse.Namespace, dict, list, int, float, set]
    values.append((lambda *_: {}, "collections.defaultdict"))  # torch fills no subclass of dict
    values += [datetime.datetime, datetime.date, datetime.time, datetime.timedelta]
    values += [datetime.timezone, np.dtype, scalar, (scalar, "numpy.core.multiarray.scalar")]
    values += [type(np.dtype(code)) for code in np.typecodes["All"].replace("O", "")]
    for name in ("PosixPath", "WindowsPath", "PurePosixPath", "PureWindowsPath"):
        path = PureWindowsPath if "Windows" in name else PurePosixPath
        values += [(path, f"pathlib.{name}"), (path, f"pathlib._local.{name}")]
    return values


def read_json(path: Path, expected: str, remedy: str = "", kind: Any = None) -> Any:
    """Read a JSON file.

    Args:
        path: File to read.
        expected: Expected file, for the message.
        remedy: Remedy, for the message.
        kind: Type of the content, e.g. a pydantic model or ``dict[str, float]``; by default any.

    Raises:
        DataError: The file cannot be read, is not JSON or has other content.
    """
    try:
        content = json.loads(checked_file(path).read_bytes())
        return content if kind is None else TypeAdapter(kind).validate_python(content)
    except (OSError, ValueError, RecursionError) as error:
        found = wrong_field(error) if isinstance(error, ValidationError) else error
        raise DataError(path, found=found, expected=expected, remedy=remedy) from error


_FORMULA = ("=", "+", "-", "@", "\t", "\r")
"""First characters of text that spreadsheets evaluate (OWASP, "CSV Injection")."""


def csv_text(columns: Sequence[str], rows: Iterable[Mapping[str, Any] | Sequence[Any]]) -> str:
    r"""Return a table as CSV, with a header.

    Text that a spreadsheet would evaluate as a formula is prefixed with ``'``: names of classes and
    files are untrusted.

    Args:
        columns: Names of the columns.
        rows: Values in the order of the columns, or by name; a missing value or None is an empty
            cell.

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


def check_new(path: Path, *, overwrite: bool) -> None:
    """Refuse to replace an existing output file, unless the user wants it.

    Raises:
        SettingError: The file exists.
    """
    if path.exists() and not overwrite:
        raise SettingError(
            "output",
            found=f"{path}, which exists",
            expected="a path that does not exist yet",
            remedy="Give another output, or overwrite=true.",
        )


def config_folder() -> Path:
    """Return the folder of the configs: the copy inside the wheel, else that of the checkout."""
    package = Path(__file__).resolve().parent
    packaged = package / "configs"
    return packaged if packaged.is_dir() else package.parent / "configs"


def label_map_file(given: str | Path) -> Path:
    """Return the file of a label map: a name of this package, or a path, see `load_label_map`."""
    folder = Path(__file__).with_name("inference") / "label_maps"
    shipped = sorted(path.stem for path in folder.glob("*.json"))
    if str(given) in shipped:
        return folder / f"{given}.json"
    if Path(given).suffix.lower() != ".json":
        check_choice("label_map", str(given), (*shipped, "a file my_map.json"))
    return Path(given)


def quoted(path: Path) -> str:
    """Return a path as Hydra reads it literally."""
    is_plain = re.fullmatch(r"[\w./-]+", str(path), re.ASCII)
    return str(path) if is_plain else "'" + str(path).replace("'", "\\'") + "'"
