"""Which sample was at work when a loader's worker process died."""

from __future__ import annotations

import os
import re
import signal
from multiprocessing import connection
from typing import TYPE_CHECKING, Any

import cv2
import torch
from torch.utils.data import DataLoader, Dataset, get_worker_info

from tangent_train.errors import DataError, SettingError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence

__all__ = ["WatchedLoader", "WatchedSamples", "explained"]

_DIED = re.compile(r"DataLoader worker \(pid (\d+)\) (.*)")
_CAUGHT = re.compile(r"\ACaught \w+ in DataLoader worker.*\.(?:Data|Setting)Error: ", re.DOTALL)
_FEWER = (
    "Use fewer workers (data.num_workers=0 works in the process itself), a lower level, or a store "
    "(data.store=…, data.in_memory=false), whose pixels are not copied."
)
_REMEDIES = {
    "Killed": "So does a system that runs out of memory. " + _FEWER,
    "Bus error": "So it ends when shared memory (/dev/shm) or a disk is full. Enlarge the shared "
    "memory (docker run --shm-size=8g), or set data.num_workers=0.",
}
_PATIENCE_S = 5.0
_OTHERWISE = "Run with data.num_workers=0: what is wrong then shows in the process itself."


class WatchedSamples(Dataset[Any]):
    """Samples of which each worker says, before it begins with one, which it is.

    Where processes share memory: a process that is killed can say nothing any more.

    Args:
        samples: By (epoch, index).
        name: Of the image or shape with an index.
        workers: Processes that read them.
    """

    def __init__(self, samples: Dataset[Any], name: Callable[[int], str], workers: int) -> None:
        self._samples = samples
        self._name = name
        # Of each worker: its process and the index.
        self._begun = torch.zeros((workers, 2), dtype=torch.int64)
        self._begun.share_memory_()  # type: ignore[no-untyped-call]

    def __len__(self) -> int:
        return len(self._samples)  # type: ignore[arg-type]

    def __getitem__(self, key: tuple[int, int]) -> Any:
        _, index = key
        worker = get_worker_info()
        if worker is not None:
            self._begun[worker.id] = torch.tensor((os.getpid(), index))
        try:
            return self._samples[key]
        except (MemoryError, cv2.error) as error:
            if isinstance(error, cv2.error) and error.code != cv2.Error.StsNoMem:
                raise
            raise DataError(
                self._name(index), found="too little memory to read it", expected="enough",
                remedy=_FEWER,
            ) from error  # fmt: skip

    def begun_by(self, process: int) -> list[str]:
        """The name of what a worker process began with last, if it is one of these."""
        rows: list[tuple[int, int]] = self._begun.tolist()
        return [self._name(index) for worker, index in rows if worker == process]


class WatchedLoader(DataLoader[Any]):
    """A loader that says it when a worker has died, also while a batch is fetched from it."""

    def __iter__(self) -> Any:
        return _each(super().__iter__())


def _each(batches: Any) -> Iterator[Any]:
    while True:
        try:
            batch = next(batches)
        except StopIteration:
            return
        except (ConnectionError, EOFError, RuntimeError) as error:
            # A batch was fetched from a worker at the moment it ended; or torch has seen that it is
            # gone and not how.
            if isinstance(error, RuntimeError) and "(pid(s) " not in str(error):
                raise
            ended = _ended(batches._workers)
            if not ended:
                raise
            raise RuntimeError(_ending(ended[0].pid, ended[0].exitcode)) from error
        yield batch


def _ended(workers: Sequence[Any]) -> list[Any]:
    """Those of the workers that end now, or have, but not as they should."""
    of_sentinel = {worker.sentinel: worker for worker in workers}
    for sentinel in connection.wait(list(of_sentinel), _PATIENCE_S):
        of_sentinel[sentinel].join(_PATIENCE_S)  # its files are closed before it has ended
    return [worker for worker in workers if worker.exitcode]


def _ending(process: int, code: int) -> str:
    """As torch says it."""
    how = f"exited unexpectedly with exit code {code}"
    if code < 0:
        how = f"is killed by signal: {signal.strsignal(-code)}"
    return f"DataLoader worker (pid {process}) {how}"


def explained(error: Exception, watched: Iterable[WatchedSamples]) -> Exception:
    """What to tell the user of an error that a loader raised for its workers.

    Args:
        error: What was raised, wherever: torch notices a dead worker by a signal.
        watched: Samples of all loaders.

    Returns:
        An error that names the sample; the same one if it is not about workers.
    """
    if isinstance(error, DataError | SettingError):
        as_raised, caught = _CAUGHT.subn("", str(error))  # without the worker's stack
        return type(error)(as_raised.rstrip()) if caught else error
    died = _DIED.match(str(error)) if isinstance(error, RuntimeError) else None
    if died is None:
        return error
    names = [name for samples in watched for name in samples.begun_by(int(died[1]))]
    how = died[2].partition(". ")[0].rstrip(". ")
    return DataError(
        ", ".join(names) or "data",
        found=f"a worker process that {how} while it read or handed over this",
        expected="one that lives",
        remedy=_REMEDIES.get(how.rpartition(": ")[2], _OTHERWISE),
    )
