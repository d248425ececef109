"""Writing files so that a reader never sees half of one."""

from __future__ import annotations

import errno
import fcntl
import os
import shutil
import tempfile
import time
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING

from tangent_train.errors import SettingError

if TYPE_CHECKING:
    from collections.abc import Iterator

__all__ = ["NoRoomError", "atomic_path", "no_room", "reserve", "write_bytes", "write_text"]

_PREFIX = ".partial-"
_FULL = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}
_PROBE = bytes(1 << 16)
_ABANDONED_S = 3600.0
_tidied: set[Path] = set()


class NoRoomError(SettingError):
    """A disk that is full, a quota that is used up, a file larger than files may be."""


def no_room(path: Path, error: BaseException) -> NoRoomError | None:
    """What to tell the user when a file did not fit.

    Args:
        path: The file.
        error: What was raised.

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
        remedy="Nothing that was there before has changed. Free some space, or write to another "
        "disk.",
    )


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside `path` that replaces it when the block succeeds.

    A process that is killed leaves the temporary file behind. It is locked while it is written, so
    the next process that writes to the folder knows what nobody works on any more, and removes it.

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
        told = no_room(path, error)
        if told is None:
            raise
        raise told from error
    _lock(handle)
    _remove_abandoned(path.parent)
    temporary = Path(name)
    try:
        temporary.chmod(0o644)
        yield temporary
        temporary.replace(path)
    except Exception as error:
        known = isinstance(error, OSError) and error.errno is not None
        told = no_room(path, error if known else _refused(temporary))
        if told is None:
            raise
        raise told from error
    finally:
        os.close(handle)
        temporary.unlink(missing_ok=True)


def reserve(path: Path) -> None:
    """Take the room of a file before its pages are written through memory.

    A mapped file has holes at first; a disk that is full when one is filled ends the process.

    Args:
        path: A file of its final size.

    Raises:
        OSError: There is too little room.
    """
    with path.open("r+b") as file:
        os.posix_fallocate(file.fileno(), 0, os.fstat(file.fileno()).st_size)


def write_bytes(path: Path, content: bytes) -> None:
    """Write `content` to `path` atomically."""
    with atomic_path(path) as temporary:
        temporary.write_bytes(content)


def write_text(path: Path, content: str) -> None:
    """Write `content` to `path` atomically, UTF-8."""
    # Names of files may hold bytes that are no text.
    write_bytes(path, content.encode(errors="backslashreplace"))


def _refused(path: Path) -> OSError:
    """Why the disk takes no more of a file: libraries fail without saying it."""
    try:
        with path.open("ab") as file:
            file.write(_PROBE)
            file.flush()
    except OSError as error:
        return error
    return OSError()


def _lock(handle: int) -> bool:
    """Whether nobody else has this file locked; where files cannot be locked, nobody knows."""
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True


def _remove_abandoned(folder: Path) -> None:
    """Remove temporary files of processes that were killed, once per process and folder.

    Young ones stay: locks of other machines are not seen on every network disk.
    """
    if folder in _tidied:
        return
    _tidied.add(folder)
    for path in folder.glob(f"{_PREFIX}*"):
        with suppress(OSError):  # gone meanwhile, or not ours to touch
            if path.is_file() and time.time() - path.stat().st_mtime > _ABANDONED_S:
                with path.open("rb") as file:
                    if _lock(file.fileno()):
                        path.unlink()
