"""Failures of the machine, explained with a remedy."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from datamodules.core.loading import explained
from tangent_train.files import no_room

__all__ = ["machine_faults"]


@contextmanager
def machine_faults(folder: Path, data: Any) -> Iterator[None]:
    """Explain a full disk, and workers that died.

    TensorBoard writes in a thread that ends with the error of a full disk; its stack is not shown.

    Args:
        folder: Of the run.
        data: Its data module.

    Raises:
        NoRoomError: The disk is full for a file that is not written atomically, as TensorBoard's
            events.
        DataError: A worker died.
    """
    show = threading.excepthook
    threading.excepthook = _all_but_full_disks(folder, show)
    try:
        yield
    except (OSError, EOFError, RuntimeError, ValueError) as error:
        told = no_room(folder, error) or explained(error, data.num_workers)
        if told is error:
            raise
        raise told from error
    finally:
        threading.excepthook = show


def _all_but_full_disks(
    folder: Path, show: Callable[[threading.ExceptHookArgs], object]
) -> Callable[[threading.ExceptHookArgs], None]:
    def hook(failed: threading.ExceptHookArgs) -> None:
        if failed.exc_value is None or no_room(folder, failed.exc_value) is None:
            show(failed)

    return hook
