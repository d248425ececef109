"""Failures of the machine, explained with a remedy."""

from __future__ import annotations

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
        NoRoomError: The disk is full for a file that is not written atomically, as TensorBoard's
            events.
        DataError: A worker died.
    """
    try:
        yield
    except (OSError, EOFError, RuntimeError, ValueError) as error:
        told = no_room(folder, error) or data.explained(error)
        if told is error:
            raise
        raise told from error
