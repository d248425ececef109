"""Write files atomically; read and write files of torch, JSON and CSV."""

from __future__ import annotations

import csv
import io
import json
import os
import re
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Annotated, Any

from pydantic import AfterValidator, TypeAdapter, ValidationError

from tangent_train.errors import DataError, SettingError, printable


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
    try:
        os.fsync(handle)
    finally:
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
    if not path.exists():
        raise DataError(path, found="no such file", expected=expected)
    import torch

    try:
        content = torch.load(path, map_location="cpu", weights_only=True, mmap=mmap)
    except Exception as error:
        if named := re.search(r"GLOBAL (\S+)", str(error)):
            found = f"{named[1]}, a class"
            remedy = "Save only its state_dict(): reading objects can run arbitrary code."
        else:
            found = "a damaged file, or not a file of torch.save"
            remedy = ""
        raise DataError(path, found=found, expected=expected, remedy=remedy) from error
    return content


def is_text(value: Any) -> bool:
    """Return True for one line of text without control characters, such as a class name."""
    return isinstance(value, str) and "\n" not in value and printable(value) == value


def is_class_name(value: Any) -> bool:
    """Return True for a text that can be written as UTF-8; names of files may not."""
    return is_text(value) and not any("\ud800" <= letter <= "\udfff" for letter in value)


def _one_line(text: str) -> str:
    if not is_text(text):
        raise ValueError("one line of text")
    return text


Text = Annotated[str, AfterValidator(_one_line)]
"""Kind of a field in a file: one line of text without control characters."""


def check_fields(
    path: Path, content: Any, kinds: Mapping[str, Any], expected: str, where: str = ""
) -> dict[str, Any]:
    """Return the fields of a mapping in a file, each of its kind.

    Args:
        path: File, for the message.
        content: Content of the file.
        kinds: Type of each field; a union with None if the field may be missing.
        expected: Expected file, for the message.
        where: Place in the file, for the message.

    Returns:
        Values of the fields; None for missing ones.

    Raises:
        DataError: The content is not a mapping, or a field is missing or of another type.
    """
    inside = f"in {where}" if where else "inside"
    if not isinstance(content, Mapping):
        found = f"{type(content).__name__} instead of a mapping {inside}"
        raise DataError(path, found=found, expected=expected)
    fields = {}
    for name, kind in kinds.items():
        value = content.get(name)
        try:
            fields[name] = TypeAdapter(kind).validate_python(value, strict=True)
        except ValidationError as error:
            found = f"no {name} {inside}" if value is None else f"{name}={value!r} {inside}"
            raise DataError(path, found=found, expected=expected) from error
    return fields


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
    from pydantic import TypeAdapter, ValidationError  # slow to import

    try:
        content = json.loads(path.read_bytes())
        return content if kind is None else TypeAdapter(kind).validate_python(content)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        found = f"{'.'.join(map(str, first['loc']))}: {first['msg']}"
        raise DataError(path, found=found, expected=expected, remedy=remedy) from error
    except (OSError, ValueError, RecursionError) as error:
        raise DataError(path, found=error, expected=expected, remedy=remedy) from error


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
