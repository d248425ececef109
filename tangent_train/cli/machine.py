"""What a machine does to a run, said so that its user knows what to do."""

from __future__ import annotations

import threading
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from tangent_train.files import no_room

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

__all__ = ["machine_faults"]


@contextmanager
def machine_faults(folder: Path, data: Any) -> Iterator[None]:
    """Explain a full disk, and workers that died.

    Args:
        folder: Of the run.
        data: Its data module.

    Raises:
        NoRoomError: Something that is not written atomically, as TensorBoard's events, found no
            room.
        DataError: A worker died.
    """
    before = threading.excepthook

    def said_once(arguments: threading.ExceptHookArgs) -> None:
        # TensorBoard's thread: it raises the same again where the next event is logged.
        if arguments.exc_value is None or no_room(folder, arguments.exc_value) is None:
            before(arguments)

    threading.excepthook = said_once
    try:
        yield
    except (OSError, EOFError, RuntimeError, ValueError) as error:
        told = no_room(folder, error) or _explained(data, error)
        if told is error:
            raise
        raise told from error
    finally:
        threading.excepthook = before


def _explained(data: Any, error: Exception) -> Exception:
    explained = getattr(data, "explained", None)
    told: Exception = error if explained is None else explained(error)
    return told
